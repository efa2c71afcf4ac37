"""Stages `summaries` and `observed_summary`: what is compared of the scan maps."""

from __future__ import annotations

import numpy as np

from warmlens.artifacts.file import Artifact, Dataset
from warmlens.products.samples import SampleTable
from warmlens.stage_table import SummariesSettings
from warmlens.stages.job import Job
from warmlens.summaries.correlation import PairGeometry, correlation_function
from warmlens.summaries.cumulative import counts_below, cumulative_distribution, threshold_grid
from warmlens.summaries.response import amplitude_correlation, mean_square_significance
from warmlens.types import FloatArray

COMBINED = "combined"
_SCAN = ("delta_r", "chi2")
_RESPONSE = ("score", "fisher")  # only with the statistic `amplitude`

Scan = dict[str, dict[str, FloatArray]]  # what the scan found, by band and name


def run(job: Job[SummariesSettings]) -> None:
    """Summarise the scans of a chunk, or of the null test."""
    with job.open("scans") as scans:
        table, span = SampleTable.read(scans), scans.span
        maps_of_band = _read_scan(scans)
        summary = _Summary(job.settings, scans)
        sizes = summary.sizes(maps_of_band)
        rows = {name: np.full((len(table), *size), np.nan) for name, size in sizes.items()}

        def summarise(row: int) -> None:
            scan = {
                band: {name: maps[row] for name, maps in of_band.items()} for band, of_band in maps_of_band.items()
            }
            for name, values in summary.of_scan(scan).items():
                if not np.isfinite(values).all():
                    raise FloatingPointError(f"the summary {name} is not finite")
                rows[name][row] = values

        table.for_each(summarise, "summaries")
    datasets = {**table.datasets(), **summary.datasets(rows, ("sample",))}
    job.write(datasets, {"bands": list(maps_of_band)}, span)


def run_observed(job: Job[SummariesSettings]) -> None:
    """Summarise the scan of the observation."""
    with job.open("observed_scan") as artifact:
        scan = _read_scan(artifact)
        summary = _Summary(job.settings, artifact)
        datasets = summary.datasets(summary.of_scan(scan), ())
    job.write(datasets, {"bands": list(scan)})


def _read_scan(artifact: Artifact) -> Scan:
    names = (*_SCAN, *_RESPONSE) if "amplitude" in artifact.settings["scan"]["statistics"] else _SCAN
    return {
        band: {name: artifact.array(f"{band}/{name}") for name in names} for band in artifact.metadata["bands"]
    }


class _Summary:
    """The summaries of one raster."""

    def __init__(self, settings: SummariesSettings, scan: Artifact) -> None:
        block = settings.summaries
        self.threshold = block.threshold
        self.valid = scan.array("raster/valid")
        self.pairs = PairGeometry.from_raster(self.valid, settings.scan.step_arcsec, block.max_separation_arcsec)
        self.thresholds = threshold_grid(block.cumulative_min, block.threshold, block.cumulative_bins)
        self.count_thresholds = np.array(block.count_thresholds)

    def of_scan(self, scan: Scan) -> dict[str, FloatArray]:
        """Summaries of one image, per band and of the sum of the bands."""
        names = next(iter(scan.values()))
        both = {**scan, COMBINED: {name: np.sum([maps[name] for maps in scan.values()], axis=0) for name in names}}
        result: dict[str, FloatArray] = {}
        for band, maps in both.items():
            delta_r = maps["delta_r"]
            result[f"{band}/correlation"] = correlation_function(delta_r, self.pairs, self.threshold)
            result[f"{band}/cumulative"] = cumulative_distribution(delta_r, self.valid, self.thresholds)
            counts = counts_below(delta_r, self.valid, self.count_thresholds)
            result[f"{band}/counts"] = counts.astype(np.float64)
            result[f"{band}/chi2"] = maps["chi2"]
            if "score" in maps:
                score, fisher = maps["score"], maps["fisher"]
                result[f"{band}/mean_z2"] = mean_square_significance(score, fisher, self.valid)
                result[f"{band}/amplitude_correlation"] = amplitude_correlation(score, fisher, self.pairs)
        return result

    def sizes(self, scan: Scan) -> dict[str, tuple[int, ...]]:
        """Shape of every summary of one image."""
        sizes: dict[str, tuple[int, ...]] = {
            "correlation": (len(self.pairs.dr_arcsec),),
            "cumulative": self.thresholds.shape,
            "counts": self.count_thresholds.shape,
            "chi2": (),
        }
        if "score" in next(iter(scan.values())):
            sizes |= {"mean_z2": (), "amplitude_correlation": (len(self.pairs.dr_arcsec),)}
        return {f"{band}/{name}": size for band in (*scan, COMBINED) for name, size in sizes.items()}

    def datasets(self, values: dict[str, FloatArray], lead: tuple[str, ...]) -> dict[str, Dataset]:
        """Values with units and axes, and the grids that they are taken on."""
        separation = (*lead, "separation")
        described = {
            "correlation": (separation, "C(dr): mean product of Delta R below the threshold"),
            "cumulative": ((*lead, "threshold"), "fraction of positions with Delta R below each threshold"),
            "counts": ((*lead, "count threshold"), "positions with Delta R below each count threshold"),
            "chi2": (lead, "chi2 of the fit with the smooth lens"),
            "mean_z2": (lead, "mean of score^2 / Fisher information over the positions"),
            "amplitude_correlation": (separation, "correlation of the amplitude, weighted by the sensitivity"),
        }
        datasets = {}
        for name, data in values.items():
            axes, description = described[name.split("/")[1]]
            datasets[name] = Dataset(np.asarray(data, dtype=np.float64), "", axes, description)
        datasets["separation"] = Dataset(self.pairs.dr_arcsec, "arcsec", ("separation",), "bins of C(dr)")
        datasets["pair_counts"] = Dataset(self.pairs.counts, "", ("separation",), "pairs of positions a bin")
        datasets["thresholds"] = Dataset(self.thresholds, "", ("threshold",), "values of Delta R")
        datasets["count_thresholds"] = Dataset(
            self.count_thresholds, "", ("count threshold",), "values of Delta R below which positions are counted"
        )
        return datasets
