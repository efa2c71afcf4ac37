"""Figure of the point spread function: as given, and as the fit improved it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from warmlens.figures.draw.axes import mask_not_positive
from warmlens.figures.draw.sky import add_colour_bar, draw_image
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.figures.inputs import Inputs, input_path, open_input
from warmlens.figures.recipe import map_table, panel_table
from warmlens.imaging.grid import PixelGrid
from warmlens.products.observation import read_observation
from warmlens.products.smooth_model import read_smooth_model
from warmlens.types import FloatArray

GIVEN_COLOUR, IMPROVED_COLOUR, ERROR_COLOUR = "#2f6f9f", "#c1403d", "0.35"
DECADES = 5.0
HALF_WIDTH_ARCSEC = 1.0
_LINEAR = 0.01  # linear part of the difference's asinh stretch over its limit


@dataclass(frozen=True)
class PsfRow:
    """PSF of one band.

    Attributes
    ----------
    given, improved, pixel_scale
        Kernels of the observation and of the smooth model [odd, odd], sum 1; size of their pixels [arcsec].
    error
        Outer edges of rings [n] [arcsec] and the error of the improved PSF in each [n]; None if not measured.
    """

    name: str
    given: FloatArray
    improved: FloatArray
    pixel_scale: float
    error: tuple[FloatArray, ...] | None = None

    @property
    def changed(self) -> bool:
        """Whether the fit took another PSF than the one it was given."""
        return not np.array_equal(self.given, self.improved)


def read(inputs: Inputs) -> list[PsfRow]:
    """Return the PSF of every band."""
    observed = read_observation(input_path(inputs, "observation"))
    model = read_smooth_model(input_path(inputs, "smooth_model"))
    rows = []
    with open_input(inputs, "smooth_model") as artifact:
        for band in observed.bands:
            names = [f"{band.name}/psf_error_radius", f"{band.name}/psf_error"]
            measured = all(name in artifact.file for name in names)
            error = tuple(artifact.array(name) for name in names) if measured else None
            rows.append(PsfRow(band.name, band.psf, model.fits[band.name].psf, observed.grid.pixel_scale, error))
    return rows


def draw(rows: list[PsfRow]) -> Figure:
    """Draw one row per band; half as wide if the fit changed no PSF."""
    n_columns = 4 if any(row.changed for row in rows) else 2
    size = (FULL_WIDTH_INCH if n_columns == 4 else 0.6 * FULL_WIDTH_INCH, 0.1 + 2.3 * len(rows))
    figure, axes = plt.subplots(len(rows), n_columns, figsize=size, squeeze=False)
    for panels, row in zip(axes, rows, strict=True):
        draw_psf_row(panels, row)
    return figure


def tabulate(rows: list[PsfRow]) -> pd.DataFrame:
    """Return the radial profiles, the errors that are left, and the kernels pixel by pixel, of each band."""
    panels = {}
    for row in rows:
        radius, given = radial_profile(row.given, row.pixel_scale)
        _, improved = radial_profile(row.improved, row.pixel_scale)
        columns = {"radius_arcsec": radius, "given_per_px": given, "improved_per_px": improved}
        panels[f"{row.name} profile"] = pd.DataFrame(columns)
        if row.error is not None:
            edges, sigma = row.error
            panels[f"{row.name} error"] = pd.DataFrame({"radius_arcsec": edges, "error_per_px": sigma})
        grid = PixelGrid.centred(row.given.shape, row.pixel_scale)
        kernels = {"given_per_px": row.given, "improved_per_px": row.improved}
        panels[f"{row.name} kernel"] = map_table(grid, kernels)
    return panel_table(panels)


def radial_profile(psf: FloatArray, pixel_scale: float) -> tuple[FloatArray, FloatArray]:
    """Return mean distance [arcsec] and mean of a kernel in rings one pixel wide about its middle, each [n].

    The first ring is the middle pixel, and rings end where they would leave the kernel.
    """
    half = psf.shape[0] // 2
    axis = np.arange(-half, half + 1)
    distance = np.hypot(axis[:, None], axis[None, :])
    ring = np.rint(distance).astype(np.int64).ravel()
    inside = ring <= half
    counts = np.bincount(ring[inside])
    radius = np.bincount(ring[inside], distance.ravel()[inside]) / counts
    return pixel_scale * radius, np.bincount(ring[inside], psf.ravel()[inside]) / counts


def draw_psf_row(axes: Sequence[Axes], row: PsfRow) -> None:
    """Draw given and improved PSF, difference and radial profiles; of an unchanged PSF only it and its profile.

    There are four panels, or two if no band's PSF was changed; those that are not needed are removed.
    """
    first, *middle, last = axes
    half = min(row.given.shape[0] // 2, round(HALF_WIDTH_ARCSEC / row.pixel_scale))
    grid = PixelGrid.centred((2 * half + 1, 2 * half + 1), row.pixel_scale)
    given, improved = (_cut(psf, half) for psf in (row.given, row.improved))
    high = float(max(given.max(), improved.max()))
    limits = (high / 10.0**DECADES, high)
    title = "given PSF" if row.changed else "PSF as given"
    shown = draw_image(first, given, grid, "log", limits)
    add_colour_bar(shown, first, rf"{title} [px$^{{-1}}$]", "top")
    first.text(0.05, 0.95, row.name, transform=first.transAxes, color="white", va="top", fontsize=9)
    if row.changed:
        shown = draw_image(middle[0], improved, grid, "log", limits)
        add_colour_bar(shown, middle[0], r"improved PSF [px$^{-1}$]", "top")
        difference = 1e3 * (improved - given)
        full = float(np.abs(difference).max())
        shown = draw_image(middle[1], difference, grid, "asinh", (-full, full), _LINEAR * full, "RdBu_r")
        add_colour_bar(shown, middle[1], r"difference [10$^{-3}$ px$^{-1}$]", "top")
    else:
        for ax in middle:
            ax.remove()
    for ax in (first, *middle) if row.changed else (first,):
        ax.label_outer()
    draw_profiles(last, row)


def draw_profiles(ax: Axes, row: PsfRow) -> None:
    """Draw radial profiles of both kernels, the rms of what was changed, and the error per ring."""
    radius, given = radial_profile(row.given, row.pixel_scale)
    shown = radius <= 2.0 * HALF_WIDTH_ARCSEC
    profiles = [(given, "-", 1.5, GIVEN_COLOUR, "given" if row.changed else "as given")]
    if row.changed:
        _, improved = radial_profile(row.improved, row.pixel_scale)
        _, square = radial_profile((row.improved - row.given) ** 2, row.pixel_scale)
        profiles.append((improved, "-", 1.0, IMPROVED_COLOUR, "improved"))
        profiles.append((np.sqrt(square), ":", 0.9, IMPROVED_COLOUR, "rms change"))
    for profile, style, width, colour, label in profiles:
        ax.plot(radius[shown], mask_not_positive(profile[shown]), ls=style, lw=width, color=colour, label=label)
    if row.error is not None:
        edges, sigma = row.error
        stairs = np.append(0.0, edges)
        ax.stairs(mask_not_positive(sigma), stairs, color=ERROR_COLOUR, lw=0.9, label="error left", baseline=None)
    ax.set_yscale("log")
    ax.set_xlim(0.0, radius[shown][-1])
    ax.set_xlabel("radius [arcsec]")
    ax.set_ylabel(r"PSF [px$^{-1}$]")
    ax.set_box_aspect(1.0)
    ax.legend(fontsize=7.5)


def _cut(psf: FloatArray, half: int) -> FloatArray:
    middle = psf.shape[0] // 2
    return psf[middle - half : middle + half + 1, middle - half : middle + half + 1]
