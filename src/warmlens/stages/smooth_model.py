"""Stage `smooth_model`: the smooth lens, given or fitted, and amplitudes of source, light and quasars."""

from __future__ import annotations

import dataclasses
import logging
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from warmlens.artifacts.file import Dataset, Provenance, write_artifact
from warmlens.config.smooth_model import SmoothModelBlock
from warmlens.fitting.lens_fit import LensFit, fit_lens, noise_sigma, outside_cores, solve_given
from warmlens.fitting.smooth_model import BandFit, SmoothModel, band_fit, scan_band
from warmlens.fitting.variable_projection import covariance, prior_axes
from warmlens.imaging.mock import lensed_image
from warmlens.imaging.noise_correlation import autocorrelation, neighbours
from warmlens.imaging.observation import Observation
from warmlens.lensing.macro_model import deflection
from warmlens.lensing.rays import SmoothRays
from warmlens.products.observation import read_observation
from warmlens.products.smooth_model import smooth_model_datasets
from warmlens.stages.settings import SmoothModelSettings
from warmlens.types import FloatArray

log = logging.getLogger(__name__)

_SMALL_DEFLECTION = 0.001  # arcsec, the rms of what substructure adds
# Noise deviations by which it may change a pixel, if by more than the arc's own light: beyond the first a warning
_WILD_RESPONSE, _REFUSED_RESPONSE = 3.0, 30.0
_CORRELATION_EXCESS = 0.1  # of neighbouring pixels' residuals over the noise of the mocks: more is a warning
_FAINT_ARC, _BRIGHT_ARC = 1.0, 10.0  # noise deviations of a pixel
_BRIGHT_EXCESS, _BRIGHT_SIGNIFICANCE = 1.1, 5.0  # chi2 a pixel of bright arcs over that of faint ones: a warning


class BrightAndFaint(NamedTuple):
    """Pixels of the arcs above 10 sigma, and from 1 to 10: how many, and chi2 a pixel."""

    n_bright: int
    n_faint: int
    bright: float
    faint: float


def run(settings: SmoothModelSettings, observation: Path, output: Path) -> None:
    """Write the smooth model.

    Raises
    ------
    ValueError
        If the fit did not converge, hit a limit, left chi2_red above the gate or has a source far finer than
        rays resolve, and `smooth_model.allow_poor_fit` is false.
    """
    provenance = Provenance("smooth_model", settings.as_dict(), {"observation": observation})
    block = settings.smooth_model
    observed = read_observation(observation)
    fitted = fit_lens(block, observed) if block.mode == "fit" else solve_given(block, observed)
    model = _product(block, observed, fitted)
    residuals = residual_correlations(block, observed, model)
    warnings = _judge(block, fitted, model.fits, wild_pixels(observed, model))
    warnings += _unlike_the_noise(block, observed, model, residuals) + _misfit_of_bright_arcs(
        block, observed, model
    )
    for warning in warnings:
        log.warning(warning)
    datasets, metadata = smooth_model_datasets(model)
    extra, description = _fit_datasets(fitted)
    for name, correlation in residuals.items():
        extra[f"{name}/residual_correlation"] = Dataset(
            correlation,
            "",
            ("row offset", "column offset"),
            "correlation of the residuals between pixels outside the quasars' cores, in units of the noise",
        )
    write_artifact(output, provenance, {**datasets, **extra}, {**metadata, **description, "warnings": warnings})


def _product(block: SmoothModelBlock, observed: Observation, fitted: LensFit) -> SmoothModel:
    """The smooth model as the campaign reads it."""
    model, solution = fitted.model, fitted.solution
    outside = outside_cores(block, observed.grid, solution.macro.quasars)
    fits = {}
    for i, band in enumerate(observed.bands):
        noise = noise_sigma(model, solution, block, band)
        fits[band.name] = band_fit(model, solution, i, noise, outside)
        fit = fits[band.name]
        log.info(
            "%s: chi2_red %.3f, without the quasars' cores %.3f, with the noise alone %.3f",
            band.name, fit.chi2_red, fit.chi2_red_outside_cores, fit.chi2_red_noise_only,
        )  # fmt: skip
    grid = observed.grid
    x, y = grid.subpixel_coordinates(block.source.supersampling)
    macro, macro_sigma = _macro_columns(fitted)
    n_quasars = len(solution.macro.quasars)
    names = [f"quasar_{i}" for i in range(n_quasars)] + [f"light_{i}" for i in range(len(model.light_models))]
    names += ["background"] * block.fit_background
    return SmoothModel(
        deflection=deflection(model.lens_models, solution.macro.kwargs_lens, *grid.coordinates()),
        rays=SmoothRays(x, y, solution.source_x, solution.source_y),
        sets=solution.sets,
        supersampling=block.source.supersampling,
        ridge=block.ridge,
        names=tuple(names),
        fixed={
            band.name: np.ascontiguousarray(solved.fixed.reshape(len(names), grid.ny * grid.nx).T)
            for band, solved in zip(observed.bands, solution.bands, strict=True)
        },
        n_quasars=n_quasars,
        fits=fits,
        lens_models=model.lens_models,
        kwargs_lens=solution.macro.kwargs_lens,
        quasars=solution.macro.quasars,
        macro=dict(zip(fits, macro, strict=True)),
        macro_sigma=macro_sigma,
    )


def _macro_columns(fitted: LensFit) -> tuple[list[FloatArray], FloatArray]:
    """What each band's image changes by along the axes of the fit's errors [npix, n], and their priors [n].

    With them as columns, a linear fit repeats the fit of all parameters to first order.
    """
    model, solution = fitted.model, fitted.solution
    if not model.space.parameters:
        return [np.empty((model.grid.ny * model.grid.nx, 0)) for _ in model.bands], np.empty(0)
    axes, sigma = prior_axes(model, solution)
    images, _ = model.derivatives(solution)
    return [image @ axes for image in images], sigma


def wild_pixels(observed: Observation, model: SmoothModel) -> dict[str, FloatArray]:
    """Pixels of each band that a deflection of 1 mas changes by more than 3 sigma and their arc's light [sigma].

    Structure of the source that is far smaller than the distance of rays can fit single pixels with any amplitude:
    chi2 does not tell, but in a mock the slightest deflection moves the rays off it.
    """
    found = {}
    for band in observed.bands:
        used, convolution = scan_band(observed, model, band.name)
        amplitudes = model.fits[band.name].source_coefficients
        light, along_x, along_y = (
            lensed_image(model.sets, amplitudes, model.rays.source_x - x, model.rays.source_y - y, convolution)
            for x, y in ((0.0, 0.0), (_SMALL_DEFLECTION, 0.0), (0.0, _SMALL_DEFLECTION))
        )
        change = np.hypot(along_x - light, along_y - light)
        wild = used.mask & (change > np.maximum(_WILD_RESPONSE * used.sigma, np.abs(light)))
        found[band.name] = change[wild] / used.sigma[wild]
    return found


def _judge(
    block: SmoothModelBlock, fitted: LensFit, fits: dict[str, BandFit], wild: dict[str, FloatArray]
) -> list[str]:
    """What is wrong with a fit: raised, or returned as warnings if the configuration allows a poor fit."""
    problems = []
    if not fitted.converged:
        steps = fitted.history[-1].evaluations
        problems.append(
            f"the smooth model did not converge in {steps} steps; raise smooth_model.fit.max_steps or start nearer"
        )
    space = fitted.model.space
    limits = [name for name, hit in zip(space.names, space.at_limit(fitted.solution.vector), strict=True) if hit]
    if limits:
        problems.append(
            f"the smooth model ran into the limits of {', '.join(limits)}; widen them in smooth_model.fit, give "
            "a prior width, or do not free them"
        )
    low, high = block.chi2_red_range
    problems += [
        f"{name}: chi2_red = {fit.chi2_red_outside_cores:.2f} of the smooth model lies above {high:g}: misfit and "
        "substructure look alike, do not trust a bound from this campaign"
        for name, fit in fits.items()
        if fit.chi2_red_outside_cores > high
    ]
    notes = [
        f"{name}: chi2_red = {fit.chi2_red_outside_cores:.2f} of the smooth model lies below {low:g}: the noise "
        "is overestimated, or the model follows it"
        for name, fit in fits.items()
        if fit.chi2_red_outside_cores < low
    ]
    for name, changes in wild.items():
        if changes.size:
            (problems if changes.max() > _REFUSED_RESPONSE else notes).append(
                f"{name}: a deflection of 1 mas changes {changes.size} pixels by more than their arc's light, by "
                f"up to {changes.max():.3g} sigma: the source has structure that rays do not resolve, and mocks "
                "will be full of it; take fewer, larger or more significant clumps (smooth_model.source.clumps), "
                "a smaller n_max, a larger smooth_model.ridge or more supersampling"
            )
    if problems and not block.allow_poor_fit:
        raise ValueError(
            "\n".join(problems) + "\nsmooth_model.allow_poor_fit: true goes on all the same, with a warning"
        )
    return problems + notes


def residual_correlations(
    block: SmoothModelBlock, observed: Observation, model: SmoothModel
) -> dict[str, FloatArray]:
    """Correlation function of each band's residuals in units of the noise, outside the quasars' cores."""
    outside = outside_cores(block, observed.grid, model.quasars)
    found = {}
    for band in observed.bands:
        fit = model.fits[band.name]
        used = band.mask & np.isfinite(fit.sigma) & outside
        found[band.name] = autocorrelation(np.where(used, (band.image - fit.model) / fit.sigma, 0.0), used)
    return found


def _unlike_the_noise(
    block: SmoothModelBlock, observed: Observation, model: SmoothModel, residuals: dict[str, FloatArray]
) -> list[str]:
    """Warnings: neighbouring pixels' residuals are alike in bands that fit, and the mocks' noise will not be."""
    warnings = []
    for band in observed.bands:
        if model.fits[band.name].chi2_red_outside_cores > block.chi2_red_range[1]:
            continue  # misfit, which has its own warning
        expected = band.noise.correlation
        in_mocks = (0.0, 0.0) if expected is None else neighbours(expected)[:2]
        in_image = neighbours(residuals[band.name])[:2]
        if max(image - mock for image, mock in zip(in_image, in_mocks, strict=True)) > _CORRELATION_EXCESS:
            warnings.append(
                f"{band.name}: neighbouring pixels' residuals correlate by {in_image[0]:.2f} along rows and "
                f"{in_image[1]:.2f} along columns, the noise of the mocks by {in_mocks[0]:.2f} and "
                f"{in_mocks[1]:.2f}: misfit, or noise that is correlated by drizzling; give "
                "observation.fits.BAND.blank_sky_arcsec, where it is measured, or noise_correlation"
            )
    return warnings


def chi2_of_arcs(block: SmoothModelBlock, observed: Observation, model: SmoothModel) -> dict[str, BrightAndFaint]:
    """chi2 a pixel of each band where the arcs are bright and where they are faint, outside the quasars' cores."""
    outside = outside_cores(block, observed.grid, model.quasars)
    found = {}
    for band in observed.bands:
        fit = model.fits[band.name]
        used = band.mask & np.isfinite(fit.sigma) & outside
        light, square = (fit.model - fit.fixed_image) / fit.sigma, ((band.image - fit.model) / fit.sigma) ** 2
        bright, faint = used & (light > _BRIGHT_ARC), used & (light > _FAINT_ARC) & (light <= _BRIGHT_ARC)
        if bright.any() and faint.any():
            numbers = int(bright.sum()), int(faint.sum())
            found[band.name] = BrightAndFaint(*numbers, float(square[bright].mean()), float(square[faint].mean()))
    return found


def _misfit_of_bright_arcs(block: SmoothModelBlock, observed: Observation, model: SmoothModel) -> list[str]:
    """Warnings: what is fitted worse the brighter it is, which no noise does; chi2 of the image can hide it."""
    warnings = []
    for name, chi2 in chi2_of_arcs(block, observed, model).items():
        if model.fits[name].chi2_red_outside_cores > block.chi2_red_range[1]:
            continue  # misfit everywhere, which has its own warning
        scatter = _BRIGHT_SIGNIFICANCE * math.sqrt(2.0 / chi2.n_bright + 2.0 / chi2.n_faint)
        if chi2.bright > chi2.faint * max(_BRIGHT_EXCESS, 1.0 + scatter):
            warnings.append(
                f"{name}: chi2 a pixel is {chi2.bright:.2f} where the arcs exceed {_BRIGHT_ARC:g} sigma "
                f"({chi2.n_bright} pixels) and {chi2.faint:.2f} where they are fainter: source, PSF or lens do "
                "not follow the image where it says most; no mock has such a misfit, and it looks like subhaloes"
            )
    return warnings


def _fit_datasets(fitted: LensFit) -> tuple[dict[str, Dataset], dict[str, Any]]:
    """Parameters with their errors, and the history of the fit."""
    model, solution = fitted.model, fitted.solution
    description: dict[str, Any] = {
        "converged": fitted.converged,
        "history": [dataclasses.asdict(step) for step in fitted.history],
        "parameters": [
            {"name": item.name, "start": item.start, "lower": item.lower, "upper": item.upper, "sigma": item.sigma}
            for item in model.space.parameters
        ],
        "source_center": solution.center.tolist(),
        "kwargs_lens_light": list(solution.macro.kwargs_light),
    }
    datasets: dict[str, Dataset] = {}
    if model.space.parameters:
        matrix = covariance(model, solution)
        axes = ("parameter",)
        datasets["parameters/value"] = Dataset(solution.vector, "", axes, "best fit, as the metadata name them")
        datasets["parameters/error"] = Dataset(np.sqrt(np.diag(matrix)), "", axes, "one sigma, priors included")
        datasets["parameters/covariance"] = Dataset(matrix, "", (*axes, *axes), "from the final curvature")
    for band, error in zip(model.bands, fitted.psf_errors or (), strict=bool(fitted.psf_errors)):
        datasets[f"{band.name}/psf_error_radius"] = Dataset(
            error.radius, "arcsec", ("ring",), "outer edges of the rings"
        )
        datasets[f"{band.name}/psf_error"] = Dataset(error.sigma, "", ("ring",), "error of the PSF in each ring")
    return datasets, description
