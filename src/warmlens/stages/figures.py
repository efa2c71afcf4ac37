"""Stage `figure`: pictures of a campaign, drawn from its artifacts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import matplotlib as mpl

mpl.use("agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from warmlens.artifacts import Artifact, ArtifactError, atomic_path, open_artifact
from warmlens.config import CosmologyBlock, RedshiftBlock
from warmlens.imaging.grid import PixelGrid
from warmlens.inference.bound import Bound
from warmlens.lensing.substructure import convergence_map
from warmlens.plots.correlation import draw_correlations, draw_cumulatives
from warmlens.plots.halo_maps import draw_deflection_panels, draw_halo_panels
from warmlens.plots.posterior import draw_mass_marginal, draw_posterior_plane
from warmlens.plots.sky import add_colour_bar, draw_diverging, draw_image
from warmlens.plots.style import house_style
from warmlens.stages.deflections import read_subhalos
from warmlens.stages.halos import geometry
from warmlens.stages.products import read_observation, read_smooth_model
from warmlens.stages.samples import OK
from warmlens.stages.summaries import COMBINED
from warmlens.types import FloatArray, IntArray

Inputs = Mapping[str, Path]
_PANELS = 6
_MAP_HALF_WIDTH, _MAP_PIXELS = 2.0, 160  # halo maps: 4" x 4", as the paper's
_RESIDUAL_LIMIT = 5.0  # sigma
_DELTA_R_LIMIT = 25.0


def run(name: str, inputs: Inputs, output: Path) -> None:
    """Draw figure `name` from the artifacts given by stage and write it as PNG."""
    with house_style():
        figure = _FIGURES[name](inputs)
        with atomic_path(output) as temporary:
            figure.savefig(temporary, format="png")
        plt.close(figure)


def _smooth_model(inputs: Inputs) -> Figure:
    """Data, model and normalised residuals, one row a band."""
    observed = read_observation(inputs["observation"])
    model = read_smooth_model(inputs["smooth_model"])
    n = len(observed.bands)
    figure, axes = plt.subplots(n, 3, figsize=(7.2, 2.5 * n), squeeze=False)
    for row, band in zip(axes, observed.bands, strict=True):
        fit = model.fits[band.name]
        image = np.where(band.mask, band.image, np.nan)
        limits = _brightness_limits(image)
        data = draw_image(row[0], image, observed.grid, "asinh", limits)
        draw_image(row[1], np.where(band.mask, fit.model, np.nan), observed.grid, "asinh", limits)
        residual = (image - fit.model) / np.where(band.mask, fit.sigma, 1.0)
        shown = draw_diverging(row[2], residual, observed.grid, _RESIDUAL_LIMIT)
        row[0].set_title(f"{band.name} observed")
        row[1].set_title("smooth model")
        row[2].set_title(rf"$\chi^2_{{\rm red}} = {fit.chi2_red:.2f}$")
        add_colour_bar(data, row[1], r"brightness [e$^-$ s$^{-1}$ px$^{-1}$]")
        add_colour_bar(shown, row[2], r"(data $-$ model) / $\sigma$")
        for ax in row:
            ax.label_outer()
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
    """Delta R maps of the observation and of a warm and a cold sample, one row a band and their sum."""
    with open_artifact(inputs["observed_scan"], "observed_scan") as artifact:
        bands = artifact.metadata["bands"]
        grid = _raster_grid(artifact)
        valid = artifact.array("raster/valid")
        columns = [{band: artifact.array(f"{band}/delta_r") for band in bands}]
    with open_artifact(inputs["scans"], "scans") as artifact:
        rows, labels = _pick_samples(artifact)
        columns += [{band: artifact[f"{band}/delta_r"][row] for band in bands} for row in (rows[0], rows[-1])]
    names = [*bands, " + ".join(bands)] if len(bands) > 1 else bands
    figure, axes = plt.subplots(
        len(names), 3, figsize=(7.2, 2.3 * len(names)), sharex=True, sharey=True, squeeze=False
    )
    for panels, name in zip(axes, names, strict=True):
        for ax, maps in zip(panels, columns, strict=True):
            delta = maps[name] if name in maps else np.sum(list(maps.values()), axis=0)
            shown = draw_diverging(ax, np.where(valid, delta, np.nan), grid, _DELTA_R_LIMIT)
            ax.label_outer()
        add_colour_bar(shown, panels[-1], rf"$\Delta R$ in {name}")
    for ax, title in zip(axes[0], ("observation", labels[0], labels[-1]), strict=True):
        ax.set_title(title)
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
    "halo_maps": _halo_maps,
    "deflection_maps": _deflection_maps,
    "mocks": _mocks,
    "delta_r": _delta_r,
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


def _raster_grid(artifact: Artifact) -> PixelGrid:
    x, y = artifact.array("raster/x"), artifact.array("raster/y")
    ny, nx = x.shape
    step = float(artifact.settings["scan"]["step_arcsec"])
    return PixelGrid(ny, nx, step, float(x[0, 0]), float(y[0, 0]))
