"""Stages `summaries`, `null_summaries` and `observed_summary`: what is compared of the scan maps.

Every summary is taken of each band and of the sum of the bands.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from warmlens.artifacts.file import Artifact, Dataset
from warmlens.products.samples import SampleTable
from warmlens.stage_table import SummariesSettings
from warmlens.stages.job import Job
from warmlens.summaries.correlation import PairGeometry, correlation_function
from warmlens.summaries.cumulative import counts_below, cumulative_distribution, threshold_grid
from warmlens.summaries.response import amplitude_correlation, mean_square_significance
from warmlens.types import BoolArray, FloatArray

COMBINED = "combined"

Maps = Mapping[str, FloatArray]  # of one image and band: delta_r, score and fisher [ny, nx], chi2


class Grids(NamedTuple):
    """What the summaries of a raster are taken on: valid positions, pairs of them, and thresholds of Delta R."""

    valid: BoolArray
    pairs: PairGeometry
    threshold: float
    thresholds: FloatArray
    count_thresholds: FloatArray

    @classmethod
    def of_scan(cls, settings: SummariesSettings, scan: Artifact) -> Grids:
        """Return the grids of the raster of a scan."""
        block, valid = settings.summaries, scan.array("raster/valid")
        return cls(
            valid,
            PairGeometry.from_raster(valid, settings.scan.step_arcsec, block.max_separation_arcsec),
            block.threshold,
            threshold_grid(block.cumulative_min, block.threshold, block.cumulative_bins),
            np.array(block.count_thresholds),
        )

    def datasets(self) -> dict[str, Dataset]:
        """Return the grids as datasets; the axes of summaries have their names."""
        separation = ("separation",)
        below = "values of Delta R below which positions are counted"
        return {
            "separation": Dataset(self.pairs.dr_arcsec, "arcsec", separation, "bins of C(dr)"),
            "pair_counts": Dataset(self.pairs.counts, "", separation, "pairs of positions per bin"),
            "thresholds": Dataset(self.thresholds, "", ("threshold",), "values of Delta R"),
            "count_thresholds": Dataset(self.count_thresholds, "", ("count threshold",), below),
        }


class Statistic(NamedTuple):
    """A summary: what computes it, the axis of its grid ("" for a single number), and what it is."""

    compute: Callable[[Maps, Grids], FloatArray]
    axis: str
    description: str


STATISTICS = {
    "correlation": Statistic(
        lambda maps, grids: correlation_function(maps["delta_r"], grids.pairs, grids.threshold),
        "separation",
        "C(dr): mean product of Delta R below the threshold",
    ),
    "cumulative": Statistic(
        lambda maps, grids: cumulative_distribution(maps["delta_r"], grids.valid, grids.thresholds),
        "threshold",
        "fraction of positions with Delta R below each threshold",
    ),
    "counts": Statistic(
        lambda maps, grids: counts_below(maps["delta_r"], grids.valid, grids.count_thresholds).astype(np.float64),
        "count threshold",
        "positions with Delta R below each count threshold",
    ),
    "chi2": Statistic(lambda maps, _: maps["chi2"], "", "chi2 of the fit with the smooth lens"),
}
OF_RESPONSE = {  # only with the scan's statistic `amplitude`
    "mean_z2": Statistic(
        lambda maps, grids: mean_square_significance(maps["score"], maps["fisher"], grids.valid),
        "",
        "mean of score^2 / Fisher information over the positions",
    ),
    "amplitude_correlation": Statistic(
        lambda maps, grids: amplitude_correlation(maps["score"], maps["fisher"], grids.pairs),
        "separation",
        "correlation of the amplitude, weighted by the sensitivity",
    ),
}


def run(job: Job[SummariesSettings]) -> None:
    """Summarise the scans of a chunk, or of the null test."""
    with job.open("scans") as scans:
        table, span = SampleTable.read(scans), scans.span
        maps_of_bands = _read_maps(scans)
        statistics = _statistics(scans)
        grids = Grids.of_scan(job.settings, scans)
    sizes = {"": (), "separation": (len(grids.pairs.dr_arcsec),), "threshold": grids.thresholds.shape}
    sizes["count threshold"] = grids.count_thresholds.shape
    rows = {
        f"{band}/{name}": np.full((len(table), *sizes[statistic.axis]), np.nan)
        for band in (*maps_of_bands, COMBINED)
        for name, statistic in statistics.items()
    }

    def summarise(row: int) -> None:
        image = {
            band: {name: values[row] for name, values in maps.items()} for band, maps in maps_of_bands.items()
        }
        for name, values in _summaries(image, statistics, grids).items():
            if not np.isfinite(values).all():
                raise FloatingPointError(f"the summary {name} is not finite")
            rows[name][row] = values

    table.for_each(summarise, "summaries")
    datasets = {**table.datasets(), **_datasets(rows, statistics, ("sample",)), **grids.datasets()}
    job.write(datasets, {"bands": list(maps_of_bands)}, span)


def run_observed(job: Job[SummariesSettings]) -> None:
    """Summarise the scan of the observation."""
    with job.open("observed_scan") as scan:
        maps_of_bands, statistics = _read_maps(scan), _statistics(scan)
        grids = Grids.of_scan(job.settings, scan)
    summaries = _summaries(maps_of_bands, statistics, grids)
    job.write({**_datasets(summaries, statistics, ()), **grids.datasets()}, {"bands": list(maps_of_bands)})


def _statistics(scan: Artifact) -> dict[str, Statistic]:
    with_response = "amplitude" in scan.settings["scan"]["statistics"]
    return {**STATISTICS, **OF_RESPONSE} if with_response else STATISTICS


def _read_maps(scan: Artifact) -> dict[str, dict[str, FloatArray]]:
    with_response = "amplitude" in scan.settings["scan"]["statistics"]
    names = ("delta_r", "chi2", "score", "fisher") if with_response else ("delta_r", "chi2")
    return {band: {name: scan.array(f"{band}/{name}") for name in names} for band in scan.metadata["bands"]}


def _summaries(
    image: Mapping[str, Maps], statistics: Mapping[str, Statistic], grids: Grids
) -> dict[str, FloatArray]:
    """Return the summaries of one image, per band and of the sum of the bands."""
    names = next(iter(image.values()))
    both = {**image, COMBINED: {name: np.sum([maps[name] for maps in image.values()], axis=0) for name in names}}
    return {
        f"{band}/{name}": statistic.compute(maps, grids)
        for band, maps in both.items()
        for name, statistic in statistics.items()
    }


def _datasets(
    values: Mapping[str, FloatArray], statistics: Mapping[str, Statistic], lead: tuple[str, ...]
) -> dict[str, Dataset]:
    datasets = {}
    for name, data in values.items():
        _, axis, description = statistics[name.split("/")[1]]
        axes = (*lead, axis) if axis else lead
        datasets[name] = Dataset(np.asarray(data, dtype=np.float64), "", axes, description)
    return datasets
