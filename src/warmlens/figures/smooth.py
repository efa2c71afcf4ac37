"""Figures of the smooth model, its PSF, and mocks made with it."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.ndimage import binary_closing
from scipy.spatial import cKDTree

from warmlens.artifacts.file import open_artifact
from warmlens.figures.draw.psf import PsfRow, draw_psf_row, radial_profile
from warmlens.figures.draw.sky import add_colour_bar, draw_diverging, draw_image
from warmlens.figures.draw.smooth_model import LensMarks, SmoothModelRow, draw_smooth_model_row, key_handles
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.figures.inputs import Inputs
from warmlens.figures.recipe import map_table, needed, panel_table
from warmlens.figures.samples import Sample, warm_to_cold
from warmlens.fitting.smooth_model import SmoothModel
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.shapelets import surface_brightness
from warmlens.lensing.critical_curves import critical_curves, inverse_magnification
from warmlens.lensing.macro_model import deflection
from warmlens.products.observation import read_observation
from warmlens.products.smooth_model import read_smooth_model
from warmlens.types import BoolArray, FloatArray

RESIDUAL_LIMIT = 5.0  # sigma
_CURVE_STEP_ARCSEC = 0.01  # a radial critical curve may be small, and its caustic large
_SOURCE_PIXELS = 240
_FAINTEST = 2.0  # 1 / magnification beyond which a pixel does not count as a look at the source
_RAYS = 3  # per pixel and axis
_GAP = 3  # pixels of the source plane: narrower gaps between rays are filled
_REACH = 1.0  # of them: those that are not fainter lie closer than that to every point between them


@dataclass(frozen=True)
class SmoothModelFigure:
    """Rows of bands, the grids of image and source plane, and what is drawn over them."""

    rows: tuple[SmoothModelRow, ...]
    grid: PixelGrid
    source_grid: PixelGrid
    lens: LensMarks

    def table(self) -> pd.DataFrame:
        """Maps of the image plane, then of the source plane, a column a band and map."""
        image: dict[str, FloatArray] = {}
        source: dict[str, FloatArray] = {}
        for row in self.rows:
            image |= {
                f"{row.name}_data_electron_per_s": row.data,
                f"{row.name}_model_electron_per_s": row.model,
                f"{row.name}_residual_sigma": row.residual,
            }
            source[f"{row.name}_source_electron_per_s_arcsec2"] = row.source
        return panel_table({"image": map_table(self.grid, image), "source": map_table(self.source_grid, source)})


def read_smooth_model_figure(inputs: Inputs) -> SmoothModelFigure:
    """Data, model, normalised residuals and source, one row a band."""
    path = needed(inputs, "smooth_model")
    observed = read_observation(needed(inputs, "observation"))
    model = read_smooth_model(path)
    with open_artifact(path, "smooth_model") as artifact:
        core = float(artifact.settings["smooth_model"]["quasar_core_arcsec"])
    lens = _lens_marks(model, observed.grid, core)
    used = np.any([np.isfinite(model.fits[band.name].sigma) & band.mask for band in observed.bands], axis=0)
    source_grid, seen = _source_plane(model, observed.grid, used, lens)
    rows = []
    for band in observed.bands:
        fit = model.fits[band.name]
        fitted = band.mask & np.isfinite(fit.sigma)
        light = surface_brightness(model.sets, fit.source_coefficients, *source_grid.coordinates())
        source = np.where(seen, light / observed.grid.pixel_scale**2, np.nan)
        data = np.where(band.mask, band.image, np.nan)
        rows.append(
            SmoothModelRow(
                name=band.name,
                data=data,
                model=np.where(fitted, fit.model, np.nan),
                residual=np.where(fitted, (band.image - fit.model) / np.where(fitted, fit.sigma, 1.0), np.nan),
                source=source,
                limits=_brightness_limits(np.where(fitted, data, np.nan)),
                source_limits=_brightness_limits(source),
                chi2_red=fit.chi2_red_outside_cores,
            )
        )
    return SmoothModelFigure(tuple(rows), observed.grid, source_grid, lens)


def draw_smooth_model_figure(data: SmoothModelFigure) -> Figure:
    """One row of four panels a band."""
    n = len(data.rows)
    figure, axes = plt.subplots(n, 4, figsize=(FULL_WIDTH_INCH, 0.55 + 2.2 * n), squeeze=False)
    for panels, row in zip(axes, data.rows, strict=True):
        draw_smooth_model_row(panels, row, data.grid, data.source_grid, data.lens)
    figure.legend(handles=key_handles(), loc="outside lower center", ncols=3)
    return figure


@dataclass(frozen=True)
class PsfFigure:
    """Rows of bands."""

    rows: tuple[PsfRow, ...]

    def table(self) -> pd.DataFrame:
        """Radial profiles, the errors that are left, and the kernels pixel by pixel, of each band."""
        panels = {}
        for row in self.rows:
            radius, given = radial_profile(row.given, row.pixel_scale)
            _, improved = radial_profile(row.improved, row.pixel_scale)
            columns = {"radius_arcsec": radius, "given_per_px": given, "improved_per_px": improved}
            panels[f"{row.name} profile"] = pd.DataFrame(columns)
            if row.error is not None:
                edges, sigma = row.error
                panels[f"{row.name} error"] = pd.DataFrame({"radius_arcsec": edges, "error_per_px": sigma})
            grid = PixelGrid.centred((len(row.given), len(row.given)), row.pixel_scale)
            maps = {"given_per_px": row.given, "improved_per_px": row.improved}
            panels[f"{row.name} kernel"] = map_table(grid, maps)
        return panel_table(panels)


def read_psf_figure(inputs: Inputs) -> PsfFigure:
    """The PSF as given and as the fit improved it, one row a band."""
    path = needed(inputs, "smooth_model")
    observed = read_observation(needed(inputs, "observation"))
    model = read_smooth_model(path)
    rows = []
    with open_artifact(path, "smooth_model") as artifact:
        for band in observed.bands:
            names = [f"{band.name}/psf_error_radius", f"{band.name}/psf_error"]
            known = all(name in artifact.file for name in names)
            error = tuple(artifact.array(name) for name in names) if known else None
            rows.append(PsfRow(band.name, band.psf, model.fits[band.name].psf, observed.grid.pixel_scale, error))
    return PsfFigure(tuple(rows))


def draw_psf_figure(data: PsfFigure) -> Figure:
    """One row a band; without a change of any PSF half as wide."""
    n_columns = 4 if any(row.changed for row in data.rows) else 2
    size = (FULL_WIDTH_INCH if n_columns == 4 else 0.6 * FULL_WIDTH_INCH, 0.1 + 2.3 * len(data.rows))
    figure, axes = plt.subplots(len(data.rows), n_columns, figsize=size, squeeze=False)
    for panels, row in zip(axes, data.rows, strict=True):
        draw_psf_row(panels, row)
    return figure


@dataclass(frozen=True)
class MockRow:
    """One band: brightness [e-/s per pixel] of observation and mock, both less the smooth model over sigma."""

    name: str
    observed: FloatArray
    mock: FloatArray
    observed_residual: FloatArray
    mock_residual: FloatArray


@dataclass(frozen=True)
class MocksFigure:
    """Rows of bands, their grid, and which sample is shown."""

    rows: tuple[MockRow, ...]
    grid: PixelGrid
    sample: Sample

    def table(self) -> pd.DataFrame:
        """A column a band and map."""
        columns: dict[str, FloatArray] = {}
        mock = f"sample_{self.sample.sample_id}"
        for row in self.rows:
            columns |= {
                f"{row.name}_observation_electron_per_s": row.observed,
                f"{row.name}_{mock}_electron_per_s": row.mock,
                f"{row.name}_observation_residual_sigma": row.observed_residual,
                f"{row.name}_{mock}_residual_sigma": row.mock_residual,
            }
        return map_table(self.grid, columns)


def read_mocks_figure(inputs: Inputs) -> MocksFigure:
    """The observation and the coldest mock of the chunk."""
    observed = read_observation(needed(inputs, "observation"))
    model = read_smooth_model(needed(inputs, "smooth_model"))
    rows = []
    with open_artifact(needed(inputs, "mocks"), "mocks") as artifact:
        sample = warm_to_cold(artifact)[-1]
        for band in observed.bands:
            fit = model.fits[band.name]
            mock = np.where(band.mask, artifact.array(f"{band.name}/image", sample.row).astype(np.float64), np.nan)
            image = np.where(band.mask, band.image, np.nan)
            sigma = np.where(band.mask, fit.sigma, 1.0)
            rows.append(MockRow(band.name, image, mock, (image - fit.model) / sigma, (mock - fit.model) / sigma))
    return MocksFigure(tuple(rows), observed.grid, sample)


def draw_mocks_figure(data: MocksFigure) -> Figure:
    """Observation, mock, and both without the smooth model, one row a band."""
    n = len(data.rows)
    figure, axes = plt.subplots(n, 4, figsize=(FULL_WIDTH_INCH, 0.6 + 2.25 * n), squeeze=False)
    for panels, row in zip(axes, data.rows, strict=True):
        limits = _brightness_limits(row.observed)
        for ax, image in ((panels[0], row.observed), (panels[1], row.mock)):
            shown = draw_image(ax, image, data.grid, "asinh", limits)
            add_colour_bar(shown, ax, r"e$^-$ s$^{-1}$ px$^{-1}$", "top")
        for ax, residual in ((panels[2], row.observed_residual), (panels[3], row.mock_residual)):
            shown = draw_diverging(ax, residual, data.grid, RESIDUAL_LIMIT)
            bar = add_colour_bar(shown, ax, r"(image $-$ smooth) / $\sigma$", "top")
            bar.set_ticks([-4, -2, 0, 2, 4])
        texts = (row.name + ", observation", row.name + ", mock", "observation", "mock")
        for ax, text, dark in zip(panels, texts, (True, True, False, False), strict=True):
            box = {"boxstyle": "square,pad=0.15", "fc": "black" if dark else "white", "ec": "none", "alpha": 0.7}
            place = {"transform": ax.transAxes, "ha": "left", "va": "top", "fontsize": 8.5, "bbox": box}
            ax.text(0.04, 0.95, text, color="white" if dark else "black", **place)
            ax.label_outer()
    figure.suptitle(f"mock: {data.sample.label}", fontsize=10)
    return figure


def _brightness_limits(image: FloatArray) -> tuple[float, float]:
    finite = image[np.isfinite(image)]
    return float(min(0.0, np.percentile(finite, 1.0))), float(np.percentile(finite, 99.8))


def _lens_marks(model: SmoothModel, grid: PixelGrid, core_arcsec: float) -> LensMarks:
    """Critical curves within the image, the quasars, and where the lens traces them to."""
    x, y = grid.coordinates()
    window = (float(x.min()), float(x.max()), float(y.min()), float(y.max()))
    curves = critical_curves(model.lens_models, model.kwargs_lens, window, _CURVE_STEP_ARCSEC)
    quasars = model.quasars
    traced = quasars.copy()
    if len(quasars):
        traced -= deflection(model.lens_models, model.kwargs_lens, quasars[:, 0], quasars[:, 1]).T
    return LensMarks(curves, quasars, traced, core_arcsec)


def _source_plane(
    model: SmoothModel, grid: PixelGrid, used: BoolArray, lens: LensMarks
) -> tuple[PixelGrid, BoolArray]:
    """Square of the source plane that holds all caustics, and where a pixel of the fit looks at it [ny, nx].

    Elsewhere the shapelets are free: rays next to the lens' centre, strongly demagnified, hardly bind them.
    """
    x, y = (axis[used.ravel()].ravel() for axis in grid.subpixel_coordinates(_RAYS))
    bright = np.abs(inverse_magnification(model.lens_models, model.kwargs_lens, x, y)) < _FAINTEST
    sky = np.column_stack([x[bright], y[bright]])
    rays = sky - deflection(model.lens_models, model.kwargs_lens, *sky.T).T
    points = np.concatenate([rays, lens.quasar_source, *(curve.source for curve in lens.curves)])
    low, high = points.min(axis=0), points.max(axis=0)
    pixels = PixelGrid.centred(
        (_SOURCE_PIXELS, _SOURCE_PIXELS), float((high - low).max()) / _SOURCE_PIXELS, *(0.5 * (low + high))
    )
    distance, _ = cKDTree(rays).query(np.column_stack([axis.ravel() for axis in pixels.coordinates()]))
    near = np.asarray(distance < _REACH * grid.pixel_scale / _RAYS).reshape(pixels.shape)
    seen: BoolArray = binary_closing(np.pad(near, _GAP), iterations=_GAP)[_GAP:-_GAP, _GAP:-_GAP]
    return pixels, seen
