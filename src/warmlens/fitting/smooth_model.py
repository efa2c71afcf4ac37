"""The finished smooth model: amplitudes, image and noise of each band, and the rays of the lens."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from warmlens.fitting.image_model import ImageModel, Solution
from warmlens.fitting.lens_fit import LensFit
from warmlens.fitting.variable_projection import prior_axes
from warmlens.imaging.observation import Band, Observation
from warmlens.imaging.psf import Convolution
from warmlens.imaging.shapelets import ShapeletSet, pixel_basis
from warmlens.lensing.macro_model import deflection
from warmlens.lensing.rays import SmoothRays
from warmlens.types import BoolArray, FloatArray

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BandFit:
    """Best amplitudes of one band."""

    # [n_source] and [n_fixed], in e-/s per pixel and per unit of the columns
    source_coefficients: FloatArray
    fixed_coefficients: FloatArray
    # Light that is not the source's, and everything, [ny, nx] [e-/s per pixel]
    fixed_image: FloatArray
    model: FloatArray
    sigma: FloatArray  # noise with the quasars' PSF error, inf where masked, [ny, nx] [e-/s per pixel]
    psf: FloatArray  # point spread function of the model, sum 1
    # Sum over the unmasked pixels of (data - model)^2 / sigma^2, and their number
    chi2: float
    n_pixels: int
    # The same without the cores of the quasar images
    chi2_outside_cores: float
    n_pixels_outside_cores: int
    chi2_noise_only: float  # as `chi2_outside_cores`, with the noise of the observation alone
    n_columns: int  # amplitudes fitted

    @property
    def chi2_red(self) -> float:
        """chi2 per degree of freedom."""
        return self.chi2 / (self.n_pixels - self.n_columns)

    @property
    def chi2_red_outside_cores(self) -> float:
        """chi2 per degree of freedom without the cores of the quasar images."""
        return self.chi2_outside_cores / (self.n_pixels_outside_cores - self.n_columns)

    @property
    def chi2_red_noise_only(self) -> float:
        """The same with the noise of the observation alone, no error of the PSF."""
        return self.chi2_noise_only / (self.n_pixels_outside_cores - self.n_columns)


@dataclass(frozen=True)
class SmoothModel:
    """What the campaign reads of the smooth model; dicts are by band.

    Attributes
    ----------
    deflection
        At the pixel centres [2, ny, nx] [arcsec].
    rays
        Sub-pixels on the sky and in the source plane.
    sets, supersampling, ridge
        Source basis, sub-pixels per pixel and axis, and prior of the linear fit.
    names, fixed
        Names and blurred images [npix, n_fixed] of the columns that no perturber moves: quasars first.
    lens_models, kwargs_lens
        The lens in lenstronomy's names.
    quasars
        Positions of the quasar images [n_quasars, 2] [arcsec].
    macro
        Change of the image when the fitted parameters move along the axes of their errors, by one sigma each
        [npix, n_axes]; none for a given lens, whose errors are not known.
    macro_sigma
        Width of the fit's own prior along each axis, in units of that sigma [n_axes], >= 1.
    """

    deflection: FloatArray
    rays: SmoothRays
    sets: tuple[ShapeletSet, ...]
    supersampling: int
    ridge: float
    names: tuple[str, ...]
    fixed: dict[str, FloatArray]
    fits: dict[str, BandFit]
    lens_models: tuple[str, ...]
    kwargs_lens: tuple[dict[str, Any], ...]
    quasars: FloatArray
    macro: dict[str, FloatArray]
    macro_sigma: FloatArray

    @property
    def n_quasars(self) -> int:
        """Number of quasar images."""
        return len(self.quasars)


def finished_model(fitted: LensFit) -> SmoothModel:
    """Smooth model of a fit, as the campaign reads it."""
    model, solution, grid = fitted.model, fitted.solution, fitted.model.grid
    bands = [band.name for band in model.bands]
    fits = {
        name: band_fit(model, solution, i, noise, fitted.outside_cores)
        for i, (name, noise) in enumerate(zip(bands, fitted.noise, strict=True))
    }
    for name, fit in fits.items():
        log.info(
            "%s: chi2_red %.3f, without the quasars' cores %.3f, with the noise alone %.3f",
            name, fit.chi2_red, fit.chi2_red_outside_cores, fit.chi2_red_noise_only,
        )  # fmt: skip
    macro, macro_sigma = _macro_columns(model, solution)
    quasars = solution.macro.quasars
    names = [f"quasar_{i}" for i in range(len(quasars))] + [f"light_{i}" for i in range(len(model.light_models))]
    names += ["background"] * model.fit_background
    return SmoothModel(
        deflection=deflection(model.lens_models, solution.macro.kwargs_lens, *grid.coordinates()),
        rays=SmoothRays(*grid.subpixel_coordinates(model.supersampling), solution.source_x, solution.source_y),
        sets=solution.sets,
        supersampling=model.supersampling,
        ridge=model.ridge,
        names=tuple(names),
        fixed={
            name: np.ascontiguousarray(solved.fixed.reshape(len(names), grid.ny * grid.nx).T)
            for name, solved in zip(bands, solution.bands, strict=True)
        },
        fits=fits,
        lens_models=model.lens_models,
        kwargs_lens=solution.macro.kwargs_lens,
        quasars=quasars,
        macro=dict(zip(bands, macro, strict=True)),
        macro_sigma=macro_sigma,
    )


def _macro_columns(model: ImageModel, solution: Solution) -> tuple[list[FloatArray], FloatArray]:
    """Return the change of each band's image along the axes of the fit's errors [npix, n], and their priors [n].

    With them as columns, a linear fit repeats the fit of all parameters to first order.
    """
    if not model.space.parameters:
        return [np.empty((model.grid.ny * model.grid.nx, 0)) for _ in model.bands], np.empty(0)
    axes, sigma = prior_axes(model, solution)
    images, _ = model.derivatives(solution)
    return [image @ axes for image in images], sigma


def band_fit(
    model: ImageModel, solution: Solution, number: int, noise_sigma: FloatArray, outside_cores: BoolArray
) -> BandFit:
    """Return what the campaign needs of band `number` of a solved model.

    `noise_sigma` is the noise of the observation alone, `outside_cores` the pixels beyond the quasars [ny, nx].

    Raises
    ------
    ValueError
        If there are not more pixels than amplitudes.
    """
    band, solved = model.bands[number], solution.bands[number]
    shape = model.grid.shape
    n_columns = solved.amplitudes.size
    outside = outside_cores.ravel()[solved.pixels]
    if np.count_nonzero(outside) <= n_columns:
        raise ValueError(
            f"band {band.name}: {n_columns} amplitudes for {np.count_nonzero(outside)} unmasked pixels outside "
            "the quasars' cores; lower smooth_model.source.n_max or unmask more pixels"
        )
    sigma = np.full(band.weights.size, np.inf)
    sigma[solved.pixels] = 1.0 / band.weights.ravel()[solved.pixels]
    residual = solved.residual * sigma[solved.pixels]
    fixed_image = np.tensordot(solved.fixed_amplitudes, solved.fixed, axes=1)
    source = solved.amplitudes[: solved.n_source]
    light = pixel_basis(solution.sets, solution.source_x, solution.source_y) @ source
    noise = noise_sigma.ravel()[solved.pixels]
    return BandFit(
        source_coefficients=source,
        fixed_coefficients=solved.fixed_amplitudes,
        fixed_image=fixed_image,
        model=model.convolutions[number].forward(light.reshape(shape)) + fixed_image,
        sigma=sigma.reshape(shape),
        psf=band.psf,
        chi2=solved.chi2,
        n_pixels=solved.pixels.size,
        chi2_outside_cores=float(np.sum(solved.residual[outside] ** 2)),
        n_pixels_outside_cores=int(outside.sum()),
        chi2_noise_only=float(np.sum((residual / noise)[outside] ** 2)),
        n_columns=n_columns,
    )


def scan_band(observation: Observation, model: SmoothModel, name: str) -> tuple[Band, Convolution]:
    """Return band `name` with the noise, the mask and the PSF of the smooth model, and its convolution."""
    band = next(band for band in observation.bands if band.name == name)
    fit = model.fits[name]
    used = band.mask & np.isfinite(fit.sigma)
    convolution = Convolution(fit.psf, observation.grid.shape)
    return replace(band, sigma=fit.sigma, mask=used, psf=fit.psf), convolution
