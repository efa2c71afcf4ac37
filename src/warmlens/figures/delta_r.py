"""Figure delta_r and Fig. 3: maps of Delta R, of R_sens, and of the linear response of the scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import open_artifact
from warmlens.figures.draw.scan import ScanRow, draw_scan_row, draw_signed_maps, name_row
from warmlens.figures.draw.sky import add_colour_bar, draw_diverging, draw_image
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.figures.inputs import Inputs, chunk_paths, input_path, open_input
from warmlens.figures.recipe import map_table
from warmlens.figures.samples import Sample, read_samples, sample_list, warm_to_cold
from warmlens.imaging.grid import PixelGrid
from warmlens.products.scan_maps import by_band, raster_grid, read_response, read_sensitivity
from warmlens.types import FloatArray

SIGNIFICANCE_LIMIT = 5.0


@dataclass(frozen=True)
class AmplitudeRow:
    """Linear response of several images; NaN is left blank."""

    significance: Sequence[FloatArray]  # best amplitude over its error of each image, [ny, nx]
    # What could be seen at each position [ny, nx], and what that is: in the figure, and in the table
    sensitivity: FloatArray
    label: str
    column: str


@dataclass(frozen=True)
class ScanFigure:
    """Maps of the observation first, then of mocks of some samples.

    There is a row per band and one for their sum; the amplitude is None if the scan has none.
    """

    rows: tuple[ScanRow, ...]
    amplitude: AmplitudeRow | None
    samples: tuple[Sample, ...]
    grid: PixelGrid


def read(inputs: Inputs) -> ScanFigure:
    """Return the maps of the observation, and of the warmest and the coldest sample of the chunk."""
    with open_input(inputs, "scans") as artifact:
        samples = warm_to_cold(artifact)
    path = input_path(inputs, "scans")
    return _read_maps(inputs, [(path, samples[0]), (path, samples[-1])])


def read_heavy_and_light(inputs: Inputs) -> ScanFigure:
    """Return the maps of Fig. 3: of the observation, and of cold samples in a heavy and in a light halo."""
    return _read_maps(inputs, heavy_and_light(chunk_paths(inputs, "scans")))


def heavy_and_light(chunks: Sequence[Path]) -> list[tuple[Path, Sample]]:
    """Return a cold sample in a heavy halo and one in a light halo, each with its chunk of the scans.

    They are nearest to the corners (highest m_TH, highest or lowest M_h) of the samples' ranges, each range being
    the unit; of a grid, the first sample at the corner.
    """
    tables = []
    for number, path in enumerate(chunks):
        with open_artifact(path, "scans") as artifact:
            tables.append(read_samples(artifact).assign(chunk=number))
    table = pd.concat(tables, ignore_index=True)
    if table.empty:
        raise ArtifactError(f"{chunks[0].parent}: no sample is left to show")
    cold, heavy = (_scale_to_range(table[name].to_numpy()) for name in ("m_th_kev", "log10_m_halo_msun"))
    places = [int(np.argmin(np.hypot(cold - 1.0, heavy - corner))) for corner in (1.0, 0.0)]
    nearest = table.iloc[places]
    return list(zip([chunks[number] for number in nearest["chunk"]], sample_list(nearest), strict=True))


def _scale_to_range(values: FloatArray) -> FloatArray:
    """Return the values over their range, 0 to 1; CDM counts as the coldest relic there is."""
    finite = values[np.isfinite(values)]
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
    return (np.minimum(values, high) - low) / (high - low if high > low else 1.0)


def _read_maps(inputs: Inputs, mocks: list[tuple[Path, Sample]]) -> ScanFigure:
    with open_input(inputs, "observed_scan") as artifact:
        grid = raster_grid(artifact)
        valid = artifact.array("raster/valid")
        r_sens = by_band(artifact, "r_sens")
        maps = [by_band(artifact, "delta_r")]
        responses = [read_response(artifact)]
        sensitivity, label = read_sensitivity(artifact, responses[0])
        column = "smallest_mass_msun" if "sensitivity/min_mass" in artifact.file else "amplitude_error_mas"
    for path, sample in mocks:
        with open_artifact(path, "scans") as artifact:
            maps.append(by_band(artifact, "delta_r", sample.row))
            responses.append(read_response(artifact, sample.row))
    rows = tuple(
        ScanRow(band, [np.where(valid, image[band], np.nan) for image in maps], np.where(valid, sens, np.nan))
        for band, sens in r_sens.items()
    )
    significance = [response.significance for response in responses if response is not None]
    amplitude = AmplitudeRow(significance, sensitivity, label, column) if significance else None
    return ScanFigure(rows, amplitude, tuple(sample for _, sample in mocks), grid)


def draw(data: ScanFigure) -> Figure:
    """Draw one row per band and one for their sum, then one of the amplitude if there is one."""
    n = len(data.rows) + (data.amplitude is not None)
    figure, axes = plt.subplots(
        n, 4, figsize=(FULL_WIDTH_INCH, 0.75 + 1.45 * n), sharex=True, sharey=True, squeeze=False
    )
    for panels, row in zip(axes, data.rows, strict=False):
        draw_scan_row(panels, row, data.grid)
    if data.amplitude is not None:
        draw_amplitude_row(axes[-1], data.amplitude, data.grid)
    titles = ("observation", *(f"mock\n{sample.label}" for sample in data.samples), "observation")
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title, fontsize=9)
    return figure


def draw_amplitude_row(axes: Sequence[Axes], row: AmplitudeRow, grid: PixelGrid) -> None:
    """Draw the best amplitude of each image in units of its error, then the error, or the smallest mass seen."""
    draw_signed_maps(axes[:-1], row.significance, grid, SIGNIFICANCE_LIMIT, r"$\hat\epsilon\,/\,\sigma_\epsilon$")
    name_row(axes[0], "all bands")
    last = axes[-1]
    finite = row.sensitivity[np.isfinite(row.sensitivity)]
    if finite.size:
        low, high = float(finite.min()), float(np.percentile(finite, 95.0))
        limits = (low, high) if low < high else (0.9 * low, 1.1 * low)
        shown = draw_image(last, row.sensitivity, grid, "log", limits, cmap="viridis_r")
        add_colour_bar(shown, last, row.label)
    else:
        draw_diverging(last, row.sensitivity, grid, 1.0)
        last.text(0.5, 0.5, "nothing within\nthe list", transform=last.transAxes, ha="center", va="center")
    last.label_outer()


def tabulate(data: ScanFigure) -> pd.DataFrame:
    """Return one column per band and map."""
    names = ["observation", *(f"sample_{sample.sample_id}" for sample in data.samples)]
    columns: dict[str, FloatArray] = {}
    for row in data.rows:
        band = row.name.replace(" ", "")
        columns |= {f"{band}_{name}_delta_r": values for name, values in zip(names, row.delta_r, strict=True)}
        columns[f"{band}_observation_r_sens"] = row.r_sens
    if data.amplitude is not None:
        pairs = zip(names, data.amplitude.significance, strict=True)
        columns |= {f"all_bands_{name}_amplitude_sigma": values for name, values in pairs}
        columns[f"all_bands_{data.amplitude.column}"] = data.amplitude.sensitivity
    return map_table(data.grid, columns)
