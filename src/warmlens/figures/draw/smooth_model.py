"""The fitted smooth lens: what it explains of the image, what is left, and the source that it sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke

from warmlens.figures.draw.sky import add_colour_bar, draw_compass, draw_diverging, draw_image
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.critical_curves import CriticalCurve
from warmlens.types import FloatArray

RESIDUAL_LIMIT = 4.0  # sigma
LENS_COLOUR = "#63d8f2"  # of critical curves, caustics and quasars: none of inferno's colours
_IMAGE_LINEAR, _SOURCE_LINEAR = 0.005, 0.05  # of the span of the limits: linear part of the asinh stretch
_OUTLINE = [withStroke(linewidth=1.5, foreground="black", alpha=0.5)]
_STAR: dict[str, Any] = {"marker": "*", "ms": 6.5, "mfc": "white", "mec": "black", "mew": 0.6, "ls": ""}


@dataclass(frozen=True)
class SmoothModelRow:
    """One band of the figure; NaN is left blank.

    Attributes
    ----------
    name
        Of the band.
    data, model
        Brightness [e-/s per pixel], [ny, nx].
    residual
        (data - model) / sigma [ny, nx].
    source
        Surface brightness of the source [e-/s per square arcsec], [ny, nx] of the source's grid.
    limits, source_limits
        First and last colour of data and model, and of the source.
    chi2_red
        Outside the cores of the quasar images.
    """

    name: str
    data: FloatArray
    model: FloatArray
    residual: FloatArray
    source: FloatArray
    limits: tuple[float, float]
    source_limits: tuple[float, float]
    chi2_red: float


@dataclass(frozen=True)
class LensMarks:
    """What is drawn over the images.

    Attributes
    ----------
    curves
        Critical curves and caustics [arcsec].
    quasars
        Quasar images [n, 2] on the sky [arcsec].
    quasar_source
        Where the lens traces each of them to [n, 2] in the source plane [arcsec].
    core_arcsec
        Radius about the quasar images that chi2_red leaves out [arcsec].
    """

    curves: Sequence[CriticalCurve]
    quasars: FloatArray
    quasar_source: FloatArray
    core_arcsec: float


def draw_smooth_model_row(
    axes: Sequence[Axes], row: SmoothModelRow, grid: PixelGrid, source_grid: PixelGrid, lens: LensMarks
) -> None:
    """Data, model with critical curves, normalised residuals, and the source with caustics.

    Parameters
    ----------
    axes
        Four panels.
    row
        What they show.
    grid, source_grid
        Pixels of the image and of the source plane.
    lens
        What is drawn over them.
    """
    data, model, residual, source = axes
    bright = r"[e$^-$ s$^{-1}$ px$^{-1}$]"
    width = _IMAGE_LINEAR * (row.limits[1] - row.limits[0])
    shown = draw_image(data, row.data, grid, "asinh", row.limits, width)
    add_colour_bar(shown, data, f"data {bright}", "top")
    _mark_quasars(data, lens.quasars, lens.core_arcsec, LENS_COLOUR)
    _name(data, row.name, "white", "black")
    draw_compass(data)

    shown = draw_image(model, row.model, grid, "asinh", row.limits, width)
    add_colour_bar(shown, model, f"model {bright}", "top")
    draw_curves(model, [curve.sky for curve in lens.curves])

    shown = draw_diverging(residual, row.residual, grid, RESIDUAL_LIMIT)
    bar = add_colour_bar(shown, residual, r"(data $-$ model) / $\sigma$", "top")
    bar.set_ticks([-4, -2, 0, 2, 4])
    _mark_quasars(residual, lens.quasars, lens.core_arcsec, "black")
    _name(residual, rf"$\chi^2_{{\rm red}} = {row.chi2_red:.2f}$ outside circles", "black", "white")

    width = _SOURCE_LINEAR * (row.source_limits[1] - row.source_limits[0])
    shown = draw_image(source, row.source, source_grid, "asinh", row.source_limits, width)
    add_colour_bar(shown, source, r"source [e$^-$ s$^{-1}$ arcsec$^{-2}$]", "top")
    draw_curves(source, [curve.source for curve in lens.curves])
    if len(lens.quasar_source):
        x, y = lens.quasar_source.mean(axis=0)
        source.plot(x, y, **_STAR, zorder=4)
    source.set_xlabel(r"$\beta_x$ [arcsec]")
    for ax in axes:
        ax.label_outer()
    source.tick_params(labelleft=True)
    source.set_ylabel(r"$\beta_y$ [arcsec]", labelpad=0.0)


def draw_curves(ax: Axes, curves: Sequence[FloatArray]) -> None:
    """Critical curves or caustics [n, 2] [arcsec], without a change of the panel's limits."""
    limits = ax.get_xlim(), ax.get_ylim()
    for curve in curves:
        ax.plot(curve[:, 0], curve[:, 1], color=LENS_COLOUR, lw=0.8, path_effects=_OUTLINE)
    ax.set_xlim(limits[0])
    ax.set_ylim(limits[1])


def _mark_quasars(ax: Axes, quasars: FloatArray, radius_arcsec: float, colour: str) -> None:
    """A circle about each quasar image."""
    for x, y in quasars:
        ax.add_patch(Circle((x, y), radius_arcsec, fc="none", ec=colour, lw=0.8))


def key_handles() -> list[Line2D]:
    """Lines and signs of the figure with their names, for its legend."""
    circle: dict[str, Any] = {"marker": "o", "ms": 6.5, "mfc": "none", "mec": "black", "mew": 0.8, "ls": ""}
    return [
        Line2D([], [], color=LENS_COLOUR, lw=1.2, path_effects=_OUTLINE, label="critical curves and caustics"),
        Line2D([], [], **_STAR, label="source position of the quasar"),
        Line2D([], [], **circle, label="cores of the quasar images"),
    ]


def _name(ax: Axes, text: str, colour: str, ground: str) -> None:
    box = {"boxstyle": "square,pad=0.15", "fc": ground, "ec": "none", "alpha": 0.7}
    ax.text(0.04, 0.95, text, transform=ax.transAxes, color=colour, ha="left", va="top", fontsize=8.5, bbox=box)
