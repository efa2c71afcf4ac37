"""The point spread function: as given, and as the fit improved it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from warmlens.figures.draw.sky import add_colour_bar, draw_image
from warmlens.imaging.grid import PixelGrid
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
    name
        Of the band.
    given, improved
        Kernels of the observation and of the smooth model [odd, odd], sum 1.
    pixel_scale
        [arcsec].
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


def radial_profile(psf: FloatArray, pixel_scale: float) -> tuple[FloatArray, FloatArray]:
    """Mean distance [arcsec] and mean of a kernel in rings one pixel wide about its middle, each [n].

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
    """Given PSF, improved PSF, difference and radial profiles; of an unchanged PSF only itself and its profile.

    Parameters
    ----------
    axes
        Four panels, or two if no band's PSF was changed; panels that are not needed are removed.
    row
        What they show.
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
    """Radial profiles of both kernels, the rms of what was changed, and the error per ring."""
    radius, given = radial_profile(row.given, row.pixel_scale)
    shown = radius <= 2.0 * HALF_WIDTH_ARCSEC
    profiles = [(given, "-", 1.5, GIVEN_COLOUR, "given" if row.changed else "as given")]
    if row.changed:
        _, improved = radial_profile(row.improved, row.pixel_scale)
        _, square = radial_profile((row.improved - row.given) ** 2, row.pixel_scale)
        profiles.append((improved, "-", 1.0, IMPROVED_COLOUR, "improved"))
        profiles.append((np.sqrt(square), ":", 0.9, IMPROVED_COLOUR, "rms change"))
    for profile, style, width, colour, label in profiles:
        ax.plot(radius[shown], _positive(profile[shown]), ls=style, lw=width, color=colour, label=label)
    if row.error is not None:
        edges, sigma = row.error
        stairs = np.append(0.0, edges)
        ax.stairs(_positive(sigma), stairs, color=ERROR_COLOUR, lw=0.9, label="error left", baseline=None)
    ax.set_yscale("log")
    ax.set_xlim(0.0, radius[shown][-1])
    ax.set_xlabel("radius [arcsec]")
    ax.set_ylabel(r"PSF [px$^{-1}$]")
    ax.set_box_aspect(1.0)
    ax.legend(fontsize=7.5)


def _cut(psf: FloatArray, half: int) -> FloatArray:
    middle = psf.shape[0] // 2
    return psf[middle - half : middle + half + 1, middle - half : middle + half + 1]


def _positive(values: FloatArray) -> FloatArray:
    """Values with those left out that a logarithmic axis cannot show."""
    return np.where(values > 0.0, values, np.nan)
