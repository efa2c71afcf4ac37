"""Stage `figure`: pictures of a campaign, drawn from its artifacts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import matplotlib as mpl

mpl.use("agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from warmlens.artifacts import Artifact, ArtifactError, atomic_path, open_artifact
from warmlens.config import CosmologyBlock, RedshiftBlock
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.shapelets import surface_brightness
from warmlens.inference.bound import Bound
from warmlens.lensing.critical_curves import critical_curves, inverse_magnification
from warmlens.lensing.macro_model import deflection
from warmlens.lensing.substructure import convergence_map
from warmlens.plots.correlation import draw_correlations, draw_cumulatives
from warmlens.plots.halo_maps import draw_deflection_panels, draw_halo_panels
from warmlens.plots.posterior import draw_mass_marginal, draw_posterior_plane
from warmlens.plots.psf import PsfRow, draw_psf_row
from warmlens.plots.scan import AmplitudeRow, ScanRow, draw_amplitude_row, draw_scan_plane, draw_scan_row
from warmlens.plots.sky import add_colour_bar, draw_diverging, draw_image
from warmlens.plots.smooth_model import LensMarks, SmoothModelRow, draw_smooth_model_row, key_handles
from warmlens.plots.style import FULL_WIDTH_INCH, house_style
from warmlens.stages.deflections import read_subhalos
from warmlens.stages.halos import geometry
from warmlens.stages.products import SmoothModel, read_observation, read_smooth_model
from warmlens.stages.samples import OK
from warmlens.stages.scan_maps import by_band, raster_grid, read_response, read_sensitivity
from warmlens.stages.summaries import COMBINED
from warmlens.types import BoolArray, FloatArray, IntArray

Inputs = Mapping[str, Path]
_PANELS = 6
_MAP_HALF_WIDTH, _MAP_PIXELS = 2.0, 160  # halo maps: 4" x 4", as the paper's
_RESIDUAL_LIMIT = 5.0  # sigma
_DELTA_R_LIMIT = 25.0
_CURVE_STEP_ARCSEC = 0.01  # a radial critical curve may be small, and its caustic large
_SOURCE_PIXELS = 240
_FAINTEST = 2.0  # 1 / magnification beyond which a pixel does not count as a look at the source
_RAYS = 3  # per pixel and axis
_REACH = 1.0  # of them: those that are not fainter lie closer than that to every point between them


def run(name: str, inputs: Inputs, output: Path) -> None:
    """Draw figure `name` from the artifacts given by stage and write it as PNG."""
    with house_style():
        figure = _FIGURES[name](inputs)
        with atomic_path(output) as temporary:
            figure.savefig(temporary, format="png")
        plt.close(figure)


def _smooth_model(inputs: Inputs) -> Figure:
    """Data, model, normalised residuals and source, one row a band."""
    observed = read_observation(inputs["observation"])
    model = read_smooth_model(inputs["smooth_model"])
    with open_artifact(inputs["smooth_model"], "smooth_model") as artifact:
        core = float(artifact.settings["smooth_model"]["quasar_core_arcsec"])
    lens = _lens_marks(model, observed.grid, core)
    used = np.any([np.isfinite(model.fits[band.name].sigma) & band.mask for band in observed.bands], axis=0)
    source_grid, seen = _source_plane(model, observed.grid, used, lens)
    n = len(observed.bands)
    figure, axes = plt.subplots(n, 4, figsize=(FULL_WIDTH_INCH, 0.55 + 2.2 * n), squeeze=False)
    for panels, band in zip(axes, observed.bands, strict=True):
        fit = model.fits[band.name]
        fitted = band.mask & np.isfinite(fit.sigma)
        light = surface_brightness(model.sets, fit.source_coefficients, *source_grid.coordinates())
        source = np.where(seen, light / observed.grid.pixel_scale**2, np.nan)
        data = np.where(band.mask, band.image, np.nan)
        row = SmoothModelRow(
            name=band.name,
            data=data,
            model=np.where(fitted, fit.model, np.nan),
            residual=np.where(fitted, (band.image - fit.model) / np.where(fitted, fit.sigma, 1.0), np.nan),
            source=source,
            limits=_brightness_limits(np.where(fitted, data, np.nan)),
            source_limits=_brightness_limits(source),
            chi2_red=fit.chi2_red_outside_cores,
        )
        draw_smooth_model_row(panels, row, observed.grid, source_grid, lens)
    figure.legend(handles=key_handles(), loc="outside lower center", ncols=3)
    return figure


def _psf(inputs: Inputs) -> Figure:
    """The PSF as given and as the fit improved it, one row a band."""
    observed = read_observation(inputs["observation"])
    model = read_smooth_model(inputs["smooth_model"])
    rows = []
    with open_artifact(inputs["smooth_model"], "smooth_model") as artifact:
        for band in observed.bands:
            names = [f"{band.name}/psf_error_radius", f"{band.name}/psf_error"]
            known = all(name in artifact.file for name in names)
            error = tuple(artifact.array(name) for name in names) if known else None
            rows.append(PsfRow(band.name, band.psf, model.fits[band.name].psf, observed.grid.pixel_scale, error))
    n_columns = 4 if any(row.changed for row in rows) else 2
    size = (FULL_WIDTH_INCH if n_columns == 4 else 0.6 * FULL_WIDTH_INCH, 0.1 + 2.3 * len(rows))
    figure, axes = plt.subplots(len(rows), n_columns, figsize=size, squeeze=False)
    for panels, row in zip(axes, rows, strict=True):
        draw_psf_row(panels, row)
    return figure


def _halo_maps(inputs: Inputs) -> Figure:
    """Projected mass of the subhaloes of samples across the range of m_TH."""
    with open_artifact(inputs["halos"], "halos") as halos:
        _, lens = geometry(
            CosmologyBlock.model_validate(halos.settings["cosmology"]),
            RedshiftBlock.model_validate(halos.settings["redshifts"]),
        )
        rows, labels = _pick_samples(halos)
        grid = PixelGrid.centred((_MAP_PIXELS, _MAP_PIXELS), 2.0 * _MAP_HALF_WIDTH / _MAP_PIXELS)
        maps = [convergence_map(read_subhalos(halos, row), grid, lens) * lens.sigma_crit_msun_kpc2 for row in rows]
    figure, axes = _panels()
    draw_halo_panels(axes, maps, grid, labels)
    return figure


def _deflection_maps(inputs: Inputs) -> Figure:
    """West component of the filtered deflections of the same samples."""
    grid = read_observation(inputs["observation"]).grid
    with open_artifact(inputs["deflections"], "deflections") as artifact:
        rows, labels = _pick_samples(artifact)
        maps = [artifact["delta_alpha"][row, 0].astype(np.float64) for row in rows]
    figure, axes = _panels()
    draw_deflection_panels(axes, maps, grid, labels, float(np.abs(maps).max()))
    return figure


def _mocks(inputs: Inputs) -> Figure:
    """The observation, a mock of it, and both without the smooth model, one row a band."""
    observed = read_observation(inputs["observation"])
    model = read_smooth_model(inputs["smooth_model"])
    n = len(observed.bands)
    figure, axes = plt.subplots(n, 4, figsize=(7.2, 2.0 * n), squeeze=False)
    with open_artifact(inputs["mocks"], "mocks") as artifact:
        rows, labels = _pick_samples(artifact)
        row = rows[-1]
        for panels, band in zip(axes, observed.bands, strict=True):
            fit = model.fits[band.name]
            mock = np.where(band.mask, artifact[f"{band.name}/image"][row], np.nan)
            image = np.where(band.mask, band.image, np.nan)
            limits = _brightness_limits(image)
            sigma = np.where(band.mask, fit.sigma, 1.0)
            for ax, data in ((panels[0], image), (panels[1], mock)):
                shown = draw_image(ax, data, observed.grid, "asinh", limits)
            for ax, data in ((panels[2], image), (panels[3], mock)):
                residual = draw_diverging(ax, (data - fit.model) / sigma, observed.grid, _RESIDUAL_LIMIT)
            add_colour_bar(shown, panels[1], rf"{band.name} [e$^-$ s$^{{-1}}$ px$^{{-1}}$]")
            add_colour_bar(residual, panels[3], r"(image $-$ smooth model) / $\sigma$")
            for ax in panels:
                ax.label_outer()
    for ax, title in zip(axes[0], ("observation", f"mock\n{labels[-1]}", "observation", "mock"), strict=True):
        ax.set_title(title)
    return figure


def _delta_r(inputs: Inputs) -> Figure:
    """Delta R maps of the observation and of a warm and a cold sample, and R_sens; one row a band and their sum.

    With the amplitude among the scan's statistics, one more row shows it for all bands together.
    """
    with open_artifact(inputs["observed_scan"], "observed_scan") as artifact:
        grid = raster_grid(artifact)
        valid = artifact.array("raster/valid")
        r_sens = by_band(artifact, "r_sens")
        columns = [by_band(artifact, "delta_r")]
        responses = [read_response(artifact)]
        last, label = read_sensitivity(artifact, responses[0])
    with open_artifact(inputs["scans"], "scans") as artifact:
        rows, labels = _pick_samples(artifact)
        for row in (rows[0], rows[-1]):
            columns.append(by_band(artifact, "delta_r", row))
            responses.append(read_response(artifact, row))
    amplitudes = [response for response in responses if response is not None]
    n = len(r_sens) + (1 if amplitudes else 0)
    figure, axes = plt.subplots(n, 4, figsize=(9.6, 2.15 * n + 0.2), sharex=True, sharey=True, squeeze=False)
    for panels, name in zip(axes, r_sens, strict=False):
        shown = [np.where(valid, maps[name], np.nan) for maps in columns]
        row_maps = ScanRow(name, shown, np.where(valid, r_sens[name], np.nan))
        brightest = float(np.percentile(r_sens[name][valid], 99.5)) if valid.any() else 0.0
        draw_scan_row(panels, row_maps, grid, _DELTA_R_LIMIT, brightest if brightest > 0.0 else 1.0)
    if amplitudes:
        significance = [item.significance for item in amplitudes]
        draw_amplitude_row(axes[-1], AmplitudeRow(significance, last, label), grid, _RESIDUAL_LIMIT)
    titles = ("observation", f"mock\n{labels[0]}", f"mock\n{labels[-1]}", "observation")
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title)
    return figure


def _scan_plane(inputs: Inputs) -> Figure:
    """Positions of the observation's scan in the plane of Delta R and R_sens, with both marginals."""
    with open_artifact(inputs["observed_scan"], "observed_scan") as artifact:
        valid = artifact.array("raster/valid")
        delta, r_sens = by_band(artifact, "delta_r"), by_band(artifact, "r_sens")
    figure, axes = plt.subplots(
        2, 2, figsize=(5.4, 5.0), width_ratios=(3.2, 1.0), height_ratios=(1.0, 3.2), sharex="col", sharey="row"
    )
    axes[0, 1].remove()
    maps = {name: (delta[name][valid], r_sens[name][valid]) for name in delta}
    draw_scan_plane(axes[1, 0], axes[0, 0], axes[1, 1], maps)
    return figure


def _correlation(inputs: Inputs) -> Figure:
    """C(dr) and cumulative distribution of all samples against the observation's."""
    with open_artifact(inputs["observed_summary"], "observed_summary") as artifact:
        separation, thresholds = artifact.array("separation"), artifact.array("thresholds")
        observed = artifact.array(f"{COMBINED}/correlation"), artifact.array(f"{COMBINED}/cumulative")
    m_th, correlation, cumulative = [], [], []
    for key in sorted(key for key in inputs if key.startswith("summaries/")):
        with open_artifact(inputs[key], "summaries") as artifact:
            good = artifact.array("samples/status") == OK
            m_th.append(artifact.array("samples/m_th_kev")[good])
            correlation.append(artifact.array(f"{COMBINED}/correlation")[good])
            cumulative.append(artifact.array(f"{COMBINED}/cumulative")[good])
    masses = np.concatenate(m_th)
    figure, axes = plt.subplots(1, 2, figsize=(7.2, 3.2))
    draw_correlations(axes[0], separation, np.concatenate(correlation), masses, observed[0])
    draw_cumulatives(axes[1], thresholds, np.concatenate(cumulative), masses, observed[1])
    return figure


def _posterior(inputs: Inputs) -> Figure:
    """Accepted samples in the plane of both parameters, and the marginal with the bound."""
    with open_artifact(inputs["abc"], "abc") as artifact:
        prior = artifact.settings["dark_matter"]
        meta = artifact.metadata
        m_th = artifact.array("table/m_th_kev")
        log10_m_halo = artifact.array("table/log10_m_halo_msun")
        accepted = artifact.array("table/accepted").astype(bool)
    bound = Bound(**{**meta["bounds"][meta["headline"]], "warnings": tuple(meta["warnings"])})
    m_range, halo_range = tuple(prior["m_th_kev"]), tuple(prior["log10_m_halo_msun"])
    figure, axes = plt.subplots(1, 2, figsize=(7.2, 3.2))
    draw_posterior_plane(axes[0], m_th, log10_m_halo, accepted, m_range, halo_range)
    draw_mass_marginal(axes[1], m_th[accepted], bound, m_range)
    return figure


_FIGURES: dict[str, Callable[[Inputs], Figure]] = {
    "smooth_model": _smooth_model,
    "psf": _psf,
    "halo_maps": _halo_maps,
    "deflection_maps": _deflection_maps,
    "mocks": _mocks,
    "delta_r": _delta_r,
    "scan_plane": _scan_plane,
    "correlation": _correlation,
    "posterior": _posterior,
}


def _panels() -> tuple[Figure, np.ndarray]:
    figure, axes = plt.subplots(2, _PANELS // 2, figsize=(7.2, 4.7), sharex=True, sharey=True)
    return figure, axes.ravel()


def _pick_samples(artifact: Artifact) -> tuple[IntArray, list[str]]:
    """Rows of up to six good samples across the range of m_TH, warm to cold, and their parameters."""
    good = np.flatnonzero(artifact.array("samples/status") == OK)
    if not good.size:
        raise ArtifactError(f"{artifact.path}: no sample of this chunk is left to show")
    m_th = artifact.array("samples/m_th_kev")
    log10_m_halo = artifact.array("samples/log10_m_halo_msun")
    ordered = good[np.argsort(m_th[good])]
    rows = ordered[np.linspace(0, len(ordered) - 1, _PANELS).round().astype(int)]
    return rows, [rf"{m_th[i]:.1f} keV, $10^{{{log10_m_halo[i]:.2f}}}$ M$_\odot$" for i in rows]


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
    near: BoolArray = np.asarray(distance < _REACH * grid.pixel_scale / _RAYS)
    return pixels, near.reshape(pixels.shape)
