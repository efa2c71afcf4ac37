"""Figure of `warmlens validate`: the images on the sky as the program takes them, and what it expects where.

It is made of the files of the user before there is an artifact, so it is no row of the registry.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("agg")

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import AbstractPathEffect, withStroke

from warmlens.figures.draw.axes import label_panel
from warmlens.figures.draw.sky import add_colour_bar, brightness_limits, draw_compass, draw_image
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.figures.recipe import Recipe, map_table, panel_table
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.observation import Band
from warmlens.imaging.psf import fwhm
from warmlens.lensing.critical_curves import critical_curves
from warmlens.types import FloatArray

_COLOUR = "#63d8f2"  # of all that is no image: none of inferno's colours
_OUTLINE: list[AbstractPathEffect] = [withStroke(linewidth=1.8, foreground="black", alpha=0.6)]
_GROUND = "0.35"  # of masked pixels, of what is no image, and of the legend: white lines are seen on it
_LINEAR = 0.004  # of the span of the limits: linear part of the asinh stretch
_PSF_DECADES = 4.0
_PSF_HALF_ARCSEC = 1.0
_CURVE_STEP_ARCSEC = 0.02
_SCALE_BARS_ARCSEC = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)


@dataclass(frozen=True)
class SkyView:
    """What the program believes of the images.

    Attributes
    ----------
    window
        Smallest x, largest x, smallest y, largest y of the scan [arcsec]; None: around the used pixels.
    lens_models, kwargs_lens
        The lens, given or the start of the fit, in lenstronomy's names; its critical curves are drawn.
    """

    grid: PixelGrid
    bands: tuple[Band, ...]
    quasars: FloatArray  # positions [n, 2] [arcsec]
    window: tuple[float, float, float, float] | None
    lens_models: Sequence[str]
    kwargs_lens: Sequence[Mapping[str, Any]]
    lens_is_given: bool


@dataclass(frozen=True)
class _Drawing:
    view: SkyView
    curves: list[FloatArray]


def write_observation(view: SkyView, output: Path) -> None:
    """Write the figure as .png, .pdf or .svg, and its maps as CSV beside it."""
    Recipe(_read, _draw, _tabulate).write(view, output)


def _read(view: SkyView) -> _Drawing:
    x, y = view.grid.coordinates()
    around = (float(x.min()), float(x.max()), float(y.min()), float(y.max()))
    curves = critical_curves(view.lens_models, view.kwargs_lens, around, _CURVE_STEP_ARCSEC)
    return _Drawing(view, [curve.sky for curve in curves])


def _draw(drawing: _Drawing) -> Figure:
    view = drawing.view
    size = (FULL_WIDTH_INCH, 0.55 + 4.1 * len(view.bands))
    figure, axes = plt.subplots(len(view.bands), 2, figsize=size, squeeze=False, width_ratios=(1.0, 0.5))
    for (left, right), band in zip(axes, view.bands, strict=True):
        _draw_band(left, drawing, band)
        _draw_psf(right, band, view.grid.pixel_scale)
    last = axes[-1, 0]
    last.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, handlelength=1.6, frameon=True,
        facecolor=_GROUND, edgecolor="none", labelcolor="white", framealpha=1.0,
    )  # fmt: skip
    return figure


def _draw_band(ax: Axes, drawing: _Drawing, band: Band) -> None:
    view, grid = drawing.view, drawing.view.grid
    shown = np.where(band.mask, band.image, np.nan)
    limits = brightness_limits(shown)
    artist = draw_image(ax, shown, grid, "asinh", limits, _LINEAR * (limits[1] - limits[0]))
    add_colour_bar(artist, ax, "e-/s per pixel")
    _hatch_masked(ax, band, grid)
    for number, curve in enumerate(drawing.curves):
        name = "critical curves, lens as given" if view.lens_is_given else "critical curves, start of the fit"
        ax.plot(*curve.T, color=_COLOUR, lw=0.9, path_effects=_OUTLINE, label=None if number else name)
    if view.window is not None:
        left, right, low, high = view.window
        corners_x, corners_y = [left, right, right, left, left], [low, low, high, high, low]
        ax.plot(
            corners_x, corners_y, "--", color="white", lw=0.9, path_effects=_OUTLINE, label="window of the scan"
        )
    if len(view.quasars):
        ax.plot(*view.quasars.T, "o", ms=9.0, mfc="none", mec=_COLOUR, mew=1.0, label="quasar images")
    for number, (x, y) in enumerate(view.quasars):
        ax.annotate(
            str(number), (x, y), (7, 5), textcoords="offset points", color=_COLOUR, fontsize=8,
            path_effects=_OUTLINE,
        )  # fmt: skip
    ax.plot(0.0, 0.0, "+", ms=8.0, color="white", mew=1.0, path_effects=_OUTLINE, label="origin of positions")
    draw_compass(ax)
    _draw_scale(ax)
    label_panel(ax, f"{band.name}: {band.mask.mean():.0%} of the pixels used")
    ax.set_xlabel("$x$, to the West [arcsec]")
    ax.set_ylabel("$y$, to the North [arcsec]")
    ax.set_facecolor(_GROUND)


def _hatch_masked(ax: Axes, band: Band, grid: PixelGrid) -> None:
    """Hatch the pixels that are not used, which are grey."""
    if band.mask.all():
        return
    x, y = grid.coordinates()
    masked = np.where(band.mask, 0.0, 1.0)
    with plt.rc_context({"hatch.linewidth": 0.4, "hatch.color": "0.6"}):
        ax.contourf(x, y, masked, levels=[0.5, 1.5], colors="none", hatches=["////"])


def _draw_scale(ax: Axes) -> None:
    """Draw a bar of a round length, at most a quarter of the image, in the lower left corner."""
    width = np.ptp(ax.get_xlim())
    length = max((bar for bar in _SCALE_BARS_ARCSEC if bar <= 0.25 * width), default=_SCALE_BARS_ARCSEC[0])
    left, low = ax.get_xlim()[0] + 0.06 * width, ax.get_ylim()[0] + 0.06 * np.ptp(ax.get_ylim())
    ax.plot([left, left + length], [low, low], color="white", lw=1.5, path_effects=_OUTLINE)
    ax.annotate(
        f"{length:g} arcsec", (left + 0.5 * length, low), (0, 3), textcoords="offset points", ha="center",
        color="white", fontsize=8, path_effects=_OUTLINE,
    )  # fmt: skip


def _draw_psf(ax: Axes, band: Band, pixel_scale: float) -> None:
    """Draw the core of the PSF on the detector's pixels, on a logarithmic scale."""
    middle = band.psf.shape[0] // 2
    half = min(middle, max(3, round(_PSF_HALF_ARCSEC / pixel_scale)))
    core = band.psf[middle - half : middle + half + 1, middle - half : middle + half + 1] / band.psf.max()
    artist = draw_image(
        ax, core, PixelGrid.centred(core.shape, 1.0), "log", (10.0**-_PSF_DECADES, 1.0), cmap="inferno"
    )
    ax.axhline(0.0, color=_COLOUR, lw=0.5)
    ax.axvline(0.0, color=_COLOUR, lw=0.5)
    add_colour_bar(artist, ax, "over the peak")
    width = fwhm(band.psf, 1.0)
    ax.set_title(f"PSF, FWHM {width * pixel_scale:.3f} arcsec = {width:.2f} pixels", fontsize=8)
    ax.set_xlabel("column from the middle [pixel]")
    ax.set_ylabel("row from the middle [pixel]")


def _tabulate(drawing: _Drawing) -> pd.DataFrame:
    view = drawing.view
    return panel_table(
        {
            band.name: map_table(view.grid, {"image_e_per_s": np.where(band.mask, band.image, np.nan)})
            for band in view.bands
        },
        "band",
    )
