"""Figure of the smooth model: what it explains of the image, what is left, and the source it reconstructs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke
from scipy.ndimage import binary_closing
from scipy.spatial import cKDTree

from warmlens.figures.draw.axes import label_panel
from warmlens.figures.draw.sky import add_colour_bar, brightness_limits, draw_compass, draw_diverging, draw_image
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.figures.inputs import Inputs, input_path, open_input
from warmlens.figures.recipe import map_table, panel_table
from warmlens.fitting.smooth_model import SmoothModel
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.shapelets import surface_brightness
from warmlens.lensing.critical_curves import CriticalCurve, critical_curves, inverse_magnification
from warmlens.lensing.macro_model import deflection
from warmlens.products.observation import read_observation
from warmlens.products.smooth_model import read_smooth_model
from warmlens.types import BoolArray, FloatArray

RESIDUAL_LIMIT = 4.0  # sigma
LENS_COLOUR = "#63d8f2"  # of critical curves, caustics and quasars: none of inferno's colours
_IMAGE_LINEAR, _SOURCE_LINEAR = 0.005, 0.05  # of the span of the limits: linear part of the asinh stretch
_OUTLINE = [withStroke(linewidth=1.5, foreground="black", alpha=0.5)]
_STAR: dict[str, Any] = {"marker": "*", "ms": 6.5, "mfc": "white", "mec": "black", "mew": 0.6, "ls": ""}
_CURVE_STEP_ARCSEC = 0.01  # a radial critical curve may be small, and its caustic large
_SOURCE_PIXELS = 240
_FAINTEST = 2.0  # 1 / magnification beyond which a pixel hardly binds the source
_RAYS = 3  # per pixel and axis
_GAP = 3  # pixels of the source plane: narrower gaps between rays are filled
_REACH = 1.0  # spacing of rays: unless they are fainter, one lies closer than that to every point between them


@dataclass(frozen=True)
class BandMaps:
    """Maps of one band, NaN where they are left blank."""

    name: str
    # Brightness [e-/s per pixel], and (data - model) / sigma, [ny, nx]
    data: FloatArray
    model: FloatArray
    residual: FloatArray
    source: FloatArray  # surface brightness of the source [e-/s per square arcsec], [ny, nx] of the source's grid
    chi2_red: float  # outside the cores of the quasar images


@dataclass(frozen=True)
class SmoothModelFigure:
    """Maps of every band, and what is drawn over them."""

    bands: tuple[BandMaps, ...]
    # Pixels of the image and of the source plane
    grid: PixelGrid
    source_grid: PixelGrid
    curves: Sequence[CriticalCurve]  # critical curves and caustics [arcsec]
    # Quasar images on the sky, and where the lens traces each to in the source plane, [n, 2] [arcsec]
    quasars: FloatArray
    quasar_source: FloatArray
    core_arcsec: float  # radius about the quasar images that chi2_red leaves out


def read(inputs: Inputs) -> SmoothModelFigure:
    """Return data, model, normalised residuals and source of every band."""
    observed = read_observation(input_path(inputs, "observation"))
    model = read_smooth_model(input_path(inputs, "smooth_model"))
    with open_input(inputs, "smooth_model") as artifact:
        core = float(artifact.settings["smooth_model"]["quasar_core_arcsec"])
    grid, lens = observed.grid, (model.lens_models, model.kwargs_lens)
    x, y = grid.coordinates()
    window = (float(x.min()), float(x.max()), float(y.min()), float(y.max()))
    curves = critical_curves(*lens, window, _CURVE_STEP_ARCSEC)
    quasar_source = model.quasars - deflection(*lens, *model.quasars.T).T if len(model.quasars) else model.quasars
    fitted = {band.name: band.mask & np.isfinite(model.fits[band.name].sigma) for band in observed.bands}
    shown = [quasar_source, *(curve.source for curve in curves)]
    source_grid, seen = _source_plane(model, grid, np.any(list(fitted.values()), axis=0), shown)
    bands = []
    for band in observed.bands:
        fit, used = model.fits[band.name], fitted[band.name]
        light = surface_brightness(model.sets, fit.source_coefficients, *source_grid.coordinates())
        bands.append(
            BandMaps(
                name=band.name,
                data=np.where(band.mask, band.image, np.nan),
                model=np.where(used, fit.model, np.nan),
                residual=np.where(used, (band.image - fit.model) / np.where(used, fit.sigma, 1.0), np.nan),
                source=np.where(seen, light / grid.pixel_scale**2, np.nan),
                chi2_red=fit.chi2_red_outside_cores,
            )
        )
    return SmoothModelFigure(tuple(bands), grid, source_grid, curves, model.quasars, quasar_source, core)


def _source_plane(
    model: SmoothModel, grid: PixelGrid, used: BoolArray, shown: list[FloatArray]
) -> tuple[PixelGrid, BoolArray]:
    """Return a square of the source plane that holds the shown points, and where a pixel of the fit sees it.

    Elsewhere the shapelets are free: rays next to the lens' centre, strongly demagnified, hardly bind them.
    """
    x, y = (axis[used.ravel()].ravel() for axis in grid.subpixel_coordinates(_RAYS))
    bright = np.abs(inverse_magnification(model.lens_models, model.kwargs_lens, x, y)) < _FAINTEST
    sky = np.column_stack([x[bright], y[bright]])
    rays = sky - deflection(model.lens_models, model.kwargs_lens, *sky.T).T
    points = np.concatenate([rays, *shown])
    low, high = points.min(axis=0), points.max(axis=0)
    pixels = PixelGrid.centred(
        (_SOURCE_PIXELS, _SOURCE_PIXELS), float((high - low).max()) / _SOURCE_PIXELS, *(0.5 * (low + high))
    )
    distance, _ = cKDTree(rays).query(np.column_stack([axis.ravel() for axis in pixels.coordinates()]))
    near = np.asarray(distance < _REACH * grid.pixel_scale / _RAYS).reshape(pixels.shape)
    seen: BoolArray = binary_closing(np.pad(near, _GAP), iterations=_GAP)[_GAP:-_GAP, _GAP:-_GAP]
    return pixels, seen


def draw(data: SmoothModelFigure) -> Figure:
    """Draw one row of four panels per band."""
    n = len(data.bands)
    figure, axes = plt.subplots(n, 4, figsize=(FULL_WIDTH_INCH, 0.55 + 2.2 * n), squeeze=False)
    for panels, maps in zip(axes, data.bands, strict=True):
        draw_band(panels, maps, data)
    circle: dict[str, Any] = {"marker": "o", "ms": 6.5, "mfc": "none", "mec": "black", "mew": 0.8, "ls": ""}
    handles = [
        Line2D([], [], color=LENS_COLOUR, lw=1.2, path_effects=_OUTLINE, label="critical curves and caustics"),
        Line2D([], [], **_STAR, label="source position of the quasar"),
        Line2D([], [], **circle, label="cores of the quasar images"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def draw_band(axes: Sequence[Axes], maps: BandMaps, figure: SmoothModelFigure) -> None:
    """Draw data, model with critical curves, normalised residuals, and the source with caustics."""
    data, model, residual, source = axes
    limits = brightness_limits(np.where(np.isfinite(maps.model), maps.data, np.nan))
    width = _IMAGE_LINEAR * (limits[1] - limits[0])
    for ax, image, name in ((data, maps.data, "data"), (model, maps.model, "model")):
        shown = draw_image(ax, image, figure.grid, "asinh", limits, width)
        add_colour_bar(shown, ax, rf"{name} [e$^-$ s$^{{-1}}$ px$^{{-1}}$]", "top")
    _mark_quasars(data, figure, LENS_COLOUR)
    label_panel(data, maps.name)
    draw_compass(data)
    draw_curves(model, [curve.sky for curve in figure.curves])

    shown = draw_diverging(residual, maps.residual, figure.grid, RESIDUAL_LIMIT)
    bar = add_colour_bar(shown, residual, r"(data $-$ model) / $\sigma$", "top")
    bar.set_ticks([-4, -2, 0, 2, 4])
    _mark_quasars(residual, figure, "black")
    label_panel(residual, rf"$\chi^2_{{\rm red}} = {maps.chi2_red:.2f}$ outside circles", "black", "white")

    limits = brightness_limits(maps.source)
    width = _SOURCE_LINEAR * (limits[1] - limits[0])
    shown = draw_image(source, maps.source, figure.source_grid, "asinh", limits, width)
    add_colour_bar(shown, source, r"source [e$^-$ s$^{-1}$ arcsec$^{-2}$]", "top")
    draw_curves(source, [curve.source for curve in figure.curves])
    if len(figure.quasar_source):
        source.plot(*figure.quasar_source.mean(axis=0), **_STAR, zorder=4)
    source.set_xlabel(r"$\beta_x$ [arcsec]")
    for ax in axes:
        ax.label_outer()
    source.tick_params(labelleft=True)
    source.set_ylabel(r"$\beta_y$ [arcsec]", labelpad=0.0)


def draw_curves(ax: Axes, curves: Sequence[FloatArray]) -> None:
    """Draw critical curves or caustics [n, 2] [arcsec], without a change of the panel's limits."""
    limits = ax.get_xlim(), ax.get_ylim()
    for curve in curves:
        ax.plot(curve[:, 0], curve[:, 1], color=LENS_COLOUR, lw=0.8, path_effects=_OUTLINE)
    ax.set_xlim(limits[0])
    ax.set_ylim(limits[1])


def _mark_quasars(ax: Axes, figure: SmoothModelFigure, colour: str) -> None:
    """Draw a circle about each quasar image."""
    for x, y in figure.quasars:
        ax.add_patch(Circle((x, y), figure.core_arcsec, fc="none", ec=colour, lw=0.8))


def tabulate(data: SmoothModelFigure) -> pd.DataFrame:
    """Return the maps of the image plane, then of the source plane, one column per band and map."""
    image: dict[str, FloatArray] = {}
    for maps in data.bands:
        image |= {
            f"{maps.name}_data_electron_per_s": maps.data,
            f"{maps.name}_model_electron_per_s": maps.model,
            f"{maps.name}_residual_sigma": maps.residual,
        }
    source = {f"{maps.name}_source_electron_per_s_arcsec2": maps.source for maps in data.bands}
    return panel_table({"image": map_table(data.grid, image), "source": map_table(data.source_grid, source)})
