"""Stages `summaries` and `observed_summary`: correlation function and cumulative distribution of scan maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warmlens.artifacts import Artifact, Dataset, Provenance, open_artifact, write_artifact
from warmlens.stages.samples import SampleTable
from warmlens.stages.settings import SummariesSettings
from warmlens.summaries.correlation import PairGeometry, correlation_function
from warmlens.summaries.cumulative import counts_below, cumulative_distribution, threshold_grid
from warmlens.types import FloatArray

COMBINED = "combined"


def run(settings: SummariesSettings, scans: Path, output: Path) -> None:
    """Summarise the scans of a chunk."""
    with open_artifact(scans, "scans") as artifact:
        provenance = Provenance("summaries", settings.as_dict(), {"scans": scans}, span=artifact.span)
        table = SampleTable.read(artifact)
        maps = {band: artifact.array(f"{band}/delta_r") for band in artifact.metadata["bands"]}
        summary = _Summary(settings, artifact)
        rows: dict[str, FloatArray] = summary.empty(len(table), [*maps, COMBINED])

        def summarise(row: int) -> None:
            for name, values in summary.of_maps({band: data[row] for band, data in maps.items()}).items():
                rows[name][row] = values

        table.for_each(summarise, "summaries")
    datasets = {**table.datasets(), **summary.datasets(rows, ("sample",))}
    write_artifact(output, provenance, datasets, {"bands": list(maps)})


def run_observed(settings: SummariesSettings, observed_scan: Path, output: Path) -> None:
    """Summarise the scan of the observation."""
    with open_artifact(observed_scan, "observed_scan") as artifact:
        provenance = Provenance("observed_summary", settings.as_dict(), {"observed_scan": observed_scan})
        maps = {band: artifact.array(f"{band}/delta_r") for band in artifact.metadata["bands"]}
        summary = _Summary(settings, artifact)
        datasets = summary.datasets(summary.of_maps(maps), ())
    write_artifact(output, provenance, datasets, {"bands": list(maps)})


class _Summary:
    """The summaries of one raster."""

    def __init__(self, settings: SummariesSettings, scan: Artifact) -> None:
        block = settings.summaries
        self.threshold = block.threshold
        self.valid = scan.array("raster/valid")
        self.pairs = PairGeometry.from_raster(self.valid, settings.scan.step_arcsec, block.max_separation_arcsec)
        self.thresholds = threshold_grid(block.cumulative_min, block.threshold, block.cumulative_bins)

    def of_maps(self, maps: dict[str, FloatArray]) -> dict[str, FloatArray]:
        """Summaries of one set of maps [ny, nx], per band and of their sum."""
        both = {**maps, COMBINED: np.sum(list(maps.values()), axis=0)}
        result: dict[str, FloatArray] = {}
        for band, delta_r in both.items():
            result[f"{band}/correlation"] = correlation_function(delta_r, self.pairs, self.threshold)
            result[f"{band}/cumulative"] = cumulative_distribution(delta_r, self.valid, self.thresholds)
            result[f"{band}/n_below"] = counts_below(delta_r, self.valid, np.array([self.threshold]))[0]
        return result

    def empty(self, n: int, bands: list[str]) -> dict[str, FloatArray]:
        """NaN rows for n samples."""
        sizes = {
            "correlation": (len(self.pairs.dr_arcsec),),
            "cumulative": self.thresholds.shape,
            "n_below": (),
        }
        return {f"{band}/{name}": np.full((n, *size), np.nan) for band in bands for name, size in sizes.items()}

    def datasets(self, values: dict[str, FloatArray], lead: tuple[str, ...]) -> dict[str, Dataset]:
        """Values with units and axes, and the grids that they are taken on."""
        described = {
            "correlation": ((*lead, "separation"), "C(dr): mean product of Delta R below the threshold"),
            "cumulative": ((*lead, "threshold"), "fraction of positions with Delta R below each threshold"),
            "n_below": (lead, "positions with Delta R below the threshold"),
        }
        datasets = {}
        for name, data in values.items():
            axes, description = described[name.split("/")[1]]
            datasets[name] = Dataset(np.asarray(data, dtype=np.float64), "", axes, description)
        datasets["separation"] = Dataset(self.pairs.dr_arcsec, "arcsec", ("separation",), "bins of C(dr)")
        datasets["pair_counts"] = Dataset(self.pairs.counts, "", ("separation",), "pairs of positions a bin")
        datasets["thresholds"] = Dataset(self.thresholds, "", ("threshold",), "values of Delta R")
        return datasets
