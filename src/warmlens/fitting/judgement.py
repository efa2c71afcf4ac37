"""Judgement of a fit: what makes a bound from it worthless, and what a reader has to know.

Problems refuse the fit unless the configuration allows a poor one; notes are warnings only. All texts are stored
with the model and belong to its digest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from warmlens.config.smooth_model import SmoothModelBlock
from warmlens.config.types import ConfigError
from warmlens.fitting.lens_fit import LensFit
from warmlens.fitting.smooth_model import SmoothModel, scan_band
from warmlens.imaging.mock import lensed_image
from warmlens.imaging.noise_correlation import autocorrelation, neighbours
from warmlens.imaging.observation import Band, Observation
from warmlens.types import BoolArray, FloatArray

_FAR_BELOW = 2.0  # distances of the lower end of chi2_red_range from 1, at least 0.1: lower by that is refused
_SMALL_DEFLECTION = 0.001  # arcsec, the rms of what substructure adds
# Noise deviations by which it may change a pixel, if by more than the arc's own light: beyond the first a warning
_UNRESOLVED_RESPONSE, _REFUSED_RESPONSE = 3.0, 30.0
_CORRELATION_EXCESS = 0.1  # of neighbouring pixels' residuals over the noise of the mocks: more is a warning
_FAINT_ARC, _BRIGHT_ARC = 1.0, 10.0  # noise deviations of a pixel
_BRIGHT_EXCESS, _BRIGHT_SIGNIFICANCE = 1.1, 5.0  # chi2 per pixel of bright arcs over that of faint: a warning


@dataclass(frozen=True)
class Judgement:
    """Problems of a poor fit that was allowed, notes, and the correlation of each band's residuals [sigma^2]."""

    problems: list[str]
    notes: list[str]
    residual_correlation: dict[str, FloatArray]


class ArcChi2(NamedTuple):
    """Pixels of the arcs above 10 sigma, and from 1 to 10: how many, and chi2 per pixel."""

    n_bright: int
    n_faint: int
    bright: float
    faint: float


class Residuals(NamedTuple):
    """Pixels of a band that the model is judged on [ny, nx], and (data - model) / sigma there, 0 elsewhere."""

    used: BoolArray
    pull: FloatArray


def judge_fit(block: SmoothModelBlock, observed: Observation, fitted: LensFit, model: SmoothModel) -> Judgement:
    """Judge a fit and its finished model.

    Raises
    ------
    ConfigError
        If the fit did not converge, hit a limit, left chi2_red above the gate or far below it or has a source
        far finer than rays resolve, and `smooth_model.allow_poor_fit` is false.
    """
    residuals = {band.name: band_residuals(band, model, fitted.outside_cores) for band in observed.bands}
    correlation = {name: autocorrelation(band.pull, band.used) for name, band in residuals.items()}
    low, high = block.chi2_red_range
    chi2_red = {name: fit.chi2_red_outside_cores for name, fit in model.fits.items()}
    problems = _unfinished(fitted) + [
        f"{name}: chi2_red = {value:.2f} of the smooth model lies above {high:g}: misfit and "
        "substructure look alike, do not trust a bound from this campaign"
        for name, value in chi2_red.items()
        if value > high
    ]
    lowest = low - _FAR_BELOW * max(abs(1.0 - low), 0.1)
    notes: list[str] = []
    for name, value in chi2_red.items():
        noise_only = model.fits[name].chi2_red_noise_only  # whatever error of the PSF was assumed beside the noise
        if value < low:
            (problems if noise_only < lowest else notes).append(
                f"{name}: chi2_red = {value:.2f} of the smooth model lies {'far ' * (noise_only < lowest)}below "
                f"{low:g}: the noise is overestimated, or the model follows it"
                + ("; compare it with the scatter of the sky (warmlens validate)" * (noise_only < lowest))
            )
    for name in model.fits:
        changes = unresolved_pixels(observed, model, name)
        if changes.size:
            (problems if changes.max() > _REFUSED_RESPONSE else notes).append(
                f"{name}: a deflection of 1 mas changes {changes.size} pixels by more than their arc's light, by "
                f"up to {changes.max():.3g} sigma: the source has structure that rays do not resolve, and mocks "
                "will be full of it; take fewer, larger or more significant clumps (smooth_model.source.clumps), "
                "a smaller n_max, a larger smooth_model.ridge or more supersampling"
            )
    if problems and not block.allow_poor_fit:
        raise ConfigError([*problems, "smooth_model.allow_poor_fit: true goes on all the same, with a warning"])
    fits_well = [band for band in observed.bands if not chi2_red[band.name] > high]  # misfit has its own warning
    for band in fits_well:
        notes += _correlation_beyond_noise(band, correlation[band.name])
    for band in fits_well:
        notes += _misfit_of_bright_arcs(band.name, chi2_of_arcs(model, band.name, residuals[band.name]))
    return Judgement(problems, notes, correlation)


def band_residuals(band: Band, model: SmoothModel, outside_cores: BoolArray) -> Residuals:
    """Return the residuals of a band outside the quasars' cores [ny, nx]."""
    fit = model.fits[band.name]
    used = band.mask & np.isfinite(fit.sigma) & outside_cores
    return Residuals(used, np.where(used, (band.image - fit.model) / fit.sigma, 0.0))


def _unfinished(fitted: LensFit) -> list[str]:
    """Return the problems of the search for the best parameters."""
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
    return problems


def unresolved_pixels(observed: Observation, model: SmoothModel, name: str) -> FloatArray:
    """Return the changes [sigma] of pixels that 1 mas of deflection changes by over 3 sigma and their arc's light.

    Structure of the source that is far smaller than the distance of rays can fit single pixels with any amplitude.
    chi2 does not show it, but in a mock the slightest deflection moves the rays off it.
    """
    used, convolution = scan_band(observed, model, name)
    amplitudes = model.fits[name].source_coefficients
    light, along_x, along_y = (
        lensed_image(model.sets, amplitudes, model.rays.source_x - x, model.rays.source_y - y, convolution)
        for x, y in ((0.0, 0.0), (_SMALL_DEFLECTION, 0.0), (0.0, _SMALL_DEFLECTION))
    )
    change = np.hypot(along_x - light, along_y - light)
    unresolved = used.mask & (change > np.maximum(_UNRESOLVED_RESPONSE * used.sigma, np.abs(light)))
    return change[unresolved] / used.sigma[unresolved]


def _correlation_beyond_noise(band: Band, correlation: FloatArray) -> list[str]:
    """Warn if neighbouring pixels' residuals are alike in a band that fits: the mocks' noise will not be."""
    in_mocks = (0.0, 0.0) if band.noise.correlation is None else neighbours(band.noise.correlation)[:2]
    in_image = neighbours(correlation)[:2]
    if max(image - mock for image, mock in zip(in_image, in_mocks, strict=True)) > _CORRELATION_EXCESS:
        return [
            f"{band.name}: neighbouring pixels' residuals correlate by {in_image[0]:.2f} along rows and "
            f"{in_image[1]:.2f} along columns, the noise of the mocks by {in_mocks[0]:.2f} and "
            f"{in_mocks[1]:.2f}: misfit, or noise that is correlated by drizzling; give "
            "observation.fits.BAND.blank_sky_arcsec, where it is measured, or noise_correlation"
        ]
    return []


def chi2_of_arcs(model: SmoothModel, name: str, residuals: Residuals) -> ArcChi2 | None:
    """Return chi2 per pixel of a band where the arcs are bright and where they are faint; None without either."""
    fit = model.fits[name]
    light = (fit.model - fit.fixed_image) / fit.sigma
    bright = residuals.used & (light > _BRIGHT_ARC)
    faint = residuals.used & (light > _FAINT_ARC) & (light <= _BRIGHT_ARC)
    if not (bright.any() and faint.any()):
        return None
    chi2 = [float(np.mean(residuals.pull[pixels] ** 2)) for pixels in (bright, faint)]
    return ArcChi2(int(bright.sum()), int(faint.sum()), *chi2)


def _misfit_of_bright_arcs(name: str, chi2: ArcChi2 | None) -> list[str]:
    """Warn of what is fitted worse the brighter it is, which no noise does; chi2 of the image can hide it."""
    if chi2 is not None:
        scatter = _BRIGHT_SIGNIFICANCE * math.sqrt(2.0 / chi2.n_bright + 2.0 / chi2.n_faint)
        if chi2.bright > chi2.faint * max(_BRIGHT_EXCESS, 1.0 + scatter):
            return [
                f"{name}: chi2 a pixel is {chi2.bright:.2f} where the arcs exceed {_BRIGHT_ARC:g} sigma "
                f"({chi2.n_bright} pixels) and {chi2.faint:.2f} where they are fainter: source, PSF or lens do "
                "not follow the image where it says most; no mock has such a misfit, and it looks like subhalos"
            ]
    return []
