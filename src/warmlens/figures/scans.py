"""Figures of the scan: maps of Delta R, of R_sens, and of the linear response."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from warmlens.artifacts.file import open_artifact
from warmlens.figures.draw.scan import AmplitudeRow, ScanRow, draw_amplitude_row, draw_scan_row
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.figures.inputs import Inputs
from warmlens.figures.recipe import all_of, map_table, needed
from warmlens.figures.samples import Sample, heavy_and_light, warm_to_cold
from warmlens.imaging.grid import PixelGrid
from warmlens.products.scan_maps import by_band, raster_grid, read_response, read_sensitivity
from warmlens.types import FloatArray

DELTA_R_LIMIT = 25.0
SIGNIFICANCE_LIMIT = 5.0


@dataclass(frozen=True)
class ScanFigure:
    """Maps of the observation and of mocks.

    Attributes
    ----------
    rows
        One a band and one for their sum; Delta R of the observation first, then of the samples.
    amplitude, told
        The linear response in the same order, and the name of its last map in the table; None and "" if the
        scan has none.
    samples
        Whose mocks are shown.
    grid
        Positions of the scan.
    """

    rows: tuple[ScanRow, ...]
    amplitude: AmplitudeRow | None
    told: str
    samples: tuple[Sample, ...]
    grid: PixelGrid

    def table(self) -> pd.DataFrame:
        """A column a band and map."""
        names = ["observation", *(f"sample_{item.sample_id}" for item in self.samples)]
        columns: dict[str, FloatArray] = {}
        for row in self.rows:
            band = row.name.replace(" ", "")
            columns |= {f"{band}_{name}_delta_r": data for name, data in zip(names, row.delta_r, strict=True)}
            columns[f"{band}_observation_r_sens"] = row.r_sens
        if self.amplitude is not None:
            pairs = zip(names, self.amplitude.significance, strict=True)
            columns |= {f"all_bands_{name}_amplitude_sigma": data for name, data in pairs}
            columns[f"all_bands_{self.told}"] = self.amplitude.last
        return map_table(self.grid, columns)


def read_delta_r(inputs: Inputs) -> ScanFigure:
    """The observation, the warmest and the coldest sample of the chunk."""
    path = needed(inputs, "scans")
    with open_artifact(path, "scans") as artifact:
        samples = warm_to_cold(artifact)
    return _scan_figure(inputs, [(path, samples[0]), (path, samples[-1])])


def read_paper_delta_r(inputs: Inputs) -> ScanFigure:
    """The observation, a cold sample in a heavy halo and one in a light halo."""
    return _scan_figure(inputs, heavy_and_light(all_of(inputs, "scans"), "scans"))


def _scan_figure(inputs: Inputs, mocks: list[tuple[Path, Sample]]) -> ScanFigure:
    with open_artifact(needed(inputs, "observed_scan"), "observed_scan") as artifact:
        grid = raster_grid(artifact)
        valid = artifact.array("raster/valid")
        r_sens = by_band(artifact, "r_sens")
        maps = [by_band(artifact, "delta_r")]
        responses = [read_response(artifact)]
        sensitivity = read_sensitivity(artifact, responses[0])
        told = "smallest_mass_msun" if "sensitivity/min_mass" in artifact.file else "amplitude_error_mas"
    for path, sample in mocks:
        with open_artifact(path, "scans") as artifact:
            maps.append(by_band(artifact, "delta_r", sample.row))
            responses.append(read_response(artifact, sample.row))
    rows = tuple(
        ScanRow(name, [np.where(valid, item[name], np.nan) for item in maps], np.where(valid, sens, np.nan))
        for name, sens in r_sens.items()
    )
    significance = [item.significance for item in responses if item is not None]
    amplitude = AmplitudeRow(significance, *sensitivity) if significance else None
    return ScanFigure(rows, amplitude, told if significance else "", tuple(item for _, item in mocks), grid)


def draw_scan_figure(data: ScanFigure) -> Figure:
    """One row a band and one for their sum, then one of the amplitude if there is one."""
    n = len(data.rows) + (data.amplitude is not None)
    figure, axes = plt.subplots(
        n, 4, figsize=(FULL_WIDTH_INCH, 0.75 + 1.45 * n), sharex=True, sharey=True, squeeze=False
    )
    for panels, row in zip(axes, data.rows, strict=False):
        draw_scan_row(panels, row, data.grid, DELTA_R_LIMIT, _brightest(row.r_sens))
    if data.amplitude is not None:
        draw_amplitude_row(axes[-1], data.amplitude, data.grid, SIGNIFICANCE_LIMIT)
    titles = ("observation", *(f"mock\n{item.label}" for item in data.samples), "observation")
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title, fontsize=9)
    return figure


def _brightest(r_sens: FloatArray) -> float:
    """R_sens of full colour."""
    lit = r_sens[np.isfinite(r_sens)]
    top = float(np.percentile(lit, 99.5)) if lit.size else 0.0
    return top if top > 0.0 else 1.0
