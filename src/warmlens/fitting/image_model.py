"""The smooth model as an image of every band, and how it changes with the parameters.

The amplitudes of source, quasars, light and background are those that fit the data best for the given parameters
(variable projection), so a step costs one linear solve per band. The derivative of the image with respect to a
parameter p of the lens follows from the gradient of the fitted source S,

    dI/dp = -P [ grad S . (d alpha/dp - d alpha_Q/dp) ],

where P is the PSF and alpha_Q the mean deflection of the quasar images: the source basis is centred on the
quasar and moves with it. What the amplitudes can follow is projected out (Kaufman 1975). The scale of the source
basis can be free: a fixed one would favour the mass sheet that stretches the source to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from warmlens.fitting.linear import cholesky_factor, whitened_design
from warmlens.fitting.parameters import Macro, Parameter, ParameterSpace
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import Convolution, point_source
from warmlens.imaging.shapelets import ShapeletSet, pixel_basis
from warmlens.imaging.source_gradient import source_gradient
from warmlens.lensing.macro_model import deflection, light_images
from warmlens.types import FloatArray, IntArray

_QUASAR_STEP = 1e-3  # arcsec, for derivatives with respect to the position of an image


@dataclass(frozen=True)
class FitBand:
    """Image and weights, 1/sigma or 0 where masked [ny, nx], of a band, and its PSF."""

    name: str
    image: FloatArray
    weights: FloatArray
    psf: FloatArray


@dataclass(frozen=True)
class SourceBasis:
    """Source basis without its centre and scale.

    Attributes
    ----------
    n_max, center
        Order of the global set, and its centre (x, y) [arcsec]; None is the quasar, the mean of its traced images.
    clumps
        Further sets; scales, and centres relative to that of the global set, in units of its scale.
    """

    n_max: int
    center: tuple[float, float] | None
    clumps: tuple[ShapeletSet, ...] = ()

    def sets(self, center: FloatArray, beta: float) -> tuple[ShapeletSet, ...]:
        """Return the shapelet sets about a centre [2] [arcsec] on a scale [arcsec]."""
        x, y = float(center[0]), float(center[1])
        clumps = (
            ShapeletSet(c.n_max, beta * c.beta, x + beta * c.center_x, y + beta * c.center_y) for c in self.clumps
        )
        return (ShapeletSet(self.n_max, beta, x, y), *clumps)


@dataclass(frozen=True)
class BandSolution:
    """Best amplitudes of a band."""

    pixels: IntArray  # flat indices of the unmasked pixels [m]
    # Whitened columns of unit norm on them [m, n]: source first, then quasars, light, background
    design: FloatArray
    factor: tuple[FloatArray, bool]  # Cholesky factor (as scipy's `cho_factor`) of design^T design + ridge
    amplitudes: FloatArray  # [n] of the columns as they are in the image: e-/s per pixel
    residual: FloatArray  # (data - model) / sigma on the unmasked pixels [m]
    fixed: FloatArray  # images of the columns that are not the source's, for amplitude 1 [n_fixed, ny, nx]

    @property
    def n_source(self) -> int:
        """Number of source columns."""
        return self.amplitudes.size - self.fixed.shape[0]

    @property
    def fixed_amplitudes(self) -> FloatArray:
        """Amplitudes of quasars, light and background [n_fixed]."""
        return self.amplitudes[self.n_source :]

    @property
    def chi2(self) -> float:
        """|residual|^2."""
        return float(self.residual @ self.residual)

    def project_out(self, columns: FloatArray) -> FloatArray:
        """Return the part of whitened columns [m, k] that the amplitudes cannot follow."""
        return columns - self.design @ linalg.cho_solve(self.factor, self.design.T @ columns)


@dataclass(frozen=True)
class Solution:
    """The model at one parameter vector: traced to the source plane, and its amplitudes band by band."""

    vector: FloatArray
    macro: Macro
    center: FloatArray  # centre of the source basis [2] [arcsec]
    quasar_sources: FloatArray  # traced quasar images [n_quasars, 2] [arcsec]
    sets: tuple[ShapeletSet, ...]
    # Traced rays [npix, s2] [arcsec]
    source_x: FloatArray
    source_y: FloatArray
    bands: tuple[BandSolution, ...]

    @property
    def chi2(self) -> float:
        """Sum over the bands."""
        return sum(band.chi2 for band in self.bands)

    @property
    def n_pixels(self) -> int:
        """Unmasked pixels of all bands."""
        return sum(band.pixels.size for band in self.bands)


@dataclass(frozen=True)
class ImageModel:
    """The smooth model of all bands as a function of its parameters.

    Attributes
    ----------
    lens_models, light_models
        lenstronomy's names of the components.
    basis, supersampling, fit_background, ridge
        Linear part.
    tie_arcsec
        How well the quasar images must trace to one source point.
    temperature
        Residuals of the image are divided by it: > 1 while a source of few shapelets leaves misfit, so that
        priors and tie keep their weight against it.
    """

    grid: PixelGrid
    bands: tuple[FitBand, ...]
    space: ParameterSpace
    lens_models: tuple[str, ...]
    light_models: tuple[str, ...]
    basis: SourceBasis
    supersampling: int
    fit_background: bool
    ridge: float
    tie_arcsec: float
    temperature: float = 1.0

    @cached_property
    def _rays(self) -> FloatArray:
        return np.array(self.grid.subpixel_coordinates(self.supersampling))

    @cached_property
    def convolutions(self) -> tuple[Convolution, ...]:
        """PSF convolution of each band."""
        return tuple(Convolution(band.psf, self.grid.shape) for band in self.bands)

    def solve(self, vector: FloatArray) -> Solution:
        """Trace the rays and solve for the amplitudes of every band."""
        macro = self.space.macro(vector)
        x, y = self._rays
        source_x, source_y = self._rays - self._deflection(macro, x, y)
        traced = macro.quasars - self._deflection(macro, *macro.quasars.T).T
        center = np.asarray(self.basis.center if self.basis.center is not None else traced.mean(axis=0))
        sets = self.basis.sets(center, macro.beta)
        source = pixel_basis(sets, source_x, source_y)
        light = self._light(macro, range(len(self.light_models)))
        bands = tuple(self._solve_band(i, source, light, macro.quasars) for i in range(len(self.bands)))
        return Solution(np.array(vector), macro, center, traced, sets, source_x, source_y, bands)

    def _solve_band(self, i: int, source: FloatArray, light: FloatArray, quasars: FloatArray) -> BandSolution:
        band, convolution = self.bands[i], self.convolutions[i]
        images = [point_source(band.psf, self.grid, x, y) for x, y in quasars]
        images += list(convolution.forward(light))
        images += [np.ones(self.grid.shape)] * self.fit_background
        fixed = np.array(images).reshape(len(images), *self.grid.shape)
        columns = fixed.reshape(len(images), band.image.size).T
        pixels = np.flatnonzero(band.weights)
        design, norms = whitened_design(source, columns, convolution, band.weights, pixels)
        normal = design.T @ design
        normal[np.diag_indices_from(normal)] += self.ridge
        factor = (cholesky_factor(normal, self.ridge), True)
        data = (band.weights * band.image).ravel()[pixels]
        scaled = linalg.cho_solve(factor, design.T @ data)
        return BandSolution(pixels, design, factor, scaled / norms, data - design @ scaled, fixed)

    def residuals(self, solution: Solution) -> FloatArray:
        """Return what the fit minimises the square of: image residuals, the quasars' tie and the priors."""
        parts = [band.residual / self.temperature for band in solution.bands]
        tie = _about_mean(solution.quasar_sources) / self.tie_arcsec
        return np.concatenate([*parts, tie.ravel(), (solution.vector - self.space.start) / self.space.prior_sigma])

    def jacobian(self, solution: Solution) -> FloatArray:
        """Return the derivative of `residuals` [n_residual, n_parameter]."""
        images, traced = self.derivatives(solution)
        rows = [
            -band.project_out(model.weights.reshape(-1, 1)[band.pixels] * image[band.pixels]) / self.temperature
            for band, model, image in zip(solution.bands, self.bands, images, strict=True)
        ]
        return np.vstack([*rows, self.prior_jacobian(traced)])

    def prior_jacobian(self, traced: FloatArray) -> FloatArray:
        """Return the rows of `jacobian` that hold no image: the quasars' tie and the priors [n_rows, n_parameter].

        `traced` is the derivative of the quasars' source points [n_quasars, 2, n_parameter].
        """
        tie = _about_mean(traced) / self.tie_arcsec
        return np.vstack([tie.reshape(-1, traced.shape[2]), np.diag(1.0 / self.space.prior_sigma)])

    def derivatives(self, solution: Solution) -> tuple[list[FloatArray], FloatArray]:
        """Return derivatives at fixed amplitudes, per unit of each parameter.

        Of each band's image [npix, n_parameter], and of the quasars' source points [n_quasars, 2, n_parameter].
        """
        parameters = self.space.parameters
        gradients = [
            source_gradient(solution.sets, band.amplitudes[: band.n_source], solution.source_x, solution.source_y)
            for band in solution.bands
        ]
        npix = self.grid.ny * self.grid.nx
        images = [np.zeros((npix, len(parameters))) for _ in self.bands]
        traced = np.zeros((*solution.quasar_sources.shape, len(parameters)))
        for j, parameter in enumerate(parameters):
            source_shift = np.zeros((2, *solution.source_x.shape))
            if parameter.kind == "lens":
                alpha, alpha_quasars = self._deflection_derivative(solution, j)
                source_shift -= alpha
                traced[:, :, j] = -alpha_quasars.T
            elif parameter.kind == "quasar":
                traced[:, :, j] = self._traced_derivative(solution, parameter)
            elif parameter.kind == "source":  # S depends on (beta - center) / scale
                center = solution.center[:, None, None]
                source_shift -= (np.array([solution.source_x, solution.source_y]) - center) / solution.macro.beta
            if self.basis.center is None:  # the source basis follows the quasar
                source_shift -= traced[:, :, j].mean(axis=0)[:, None, None]
            lights = self._lights_of(parameter)
            up, down = (self._light(macro, lights) for macro in self._macros_beside(solution.vector, j))
            light = (up - down) / (2.0 * parameter.step)
            for i, (solved, gradient, image) in enumerate(zip(solution.bands, gradients, images, strict=True)):
                change = np.sum(np.array(gradient) * source_shift, axis=0).mean(axis=-1).reshape(self.grid.shape)
                for component, derivative in zip(lights, light, strict=True):
                    change += solved.fixed_amplitudes[len(solution.macro.quasars) + component] * derivative
                image[:, j] = self.convolutions[i].forward(change).ravel()
                if parameter.kind == "quasar":
                    point = self._point_derivative(solution, parameter, self.bands[i].psf)
                    image[:, j] += solved.fixed_amplitudes[parameter.component] * point.ravel()
        return images, traced

    def _deflection(self, macro: Macro, x: FloatArray, y: FloatArray) -> FloatArray:
        return deflection(self.lens_models, macro.kwargs_lens, x, y)

    def _light(self, macro: Macro, components: Sequence[int]) -> FloatArray:
        """Return the light per pixel for amplitude 1, before the PSF [component, ny, nx]."""
        names = [self.light_models[i] for i in components]
        kwargs = [macro.kwargs_light[i] for i in components]
        return light_images(names, kwargs, self.grid, self.supersampling)

    @cached_property
    def _unit_deflections(self) -> dict[int, FloatArray]:
        """Deflection of each potential shapelet for coefficient 1: the same in every step."""
        parameters = enumerate(self.space.parameters)
        return {j: self._unit_deflection(p, *self._rays) for j, p in parameters if p.key == "coeffs"}

    def _unit_deflection(self, parameter: Parameter, x: FloatArray, y: FloatArray) -> FloatArray:
        kwargs = dict(self.space.base.kwargs_lens[parameter.component])
        kwargs["coeffs"] = [float(i == parameter.element) for i in range(len(kwargs["coeffs"]))]
        return deflection([self.lens_models[parameter.component]], [kwargs], x, y)

    def _deflection_derivative(self, solution: Solution, j: int) -> tuple[FloatArray, FloatArray]:
        """Return d alpha / dp at the rays [2, npix, s2] and at the quasar images [2, n_quasars]."""
        parameter = self.space.parameters[j]
        quasars = solution.macro.quasars.T
        if parameter.key == "coeffs":
            return self._unit_deflections[j], self._unit_deflection(parameter, *quasars)
        name = [self.lens_models[parameter.component]]
        up, down = (
            [deflection(name, [macro.kwargs_lens[parameter.component]], *xy) for xy in (self._rays, quasars)]
            for macro in self._macros_beside(solution.vector, j)
        )
        at_rays, at_quasars = ((a - b) / (2.0 * parameter.step) for a, b in zip(up, down, strict=True))
        return at_rays, at_quasars

    def _lights_of(self, parameter: Parameter) -> list[int]:
        """Return the light components that a parameter shapes."""
        if parameter.kind == "light":
            return [parameter.component]
        if parameter.kind == "lens" and parameter.key in ("center_x", "center_y"):
            return [light for lens, light in self.space.satellites if lens == parameter.component]
        return []

    def _macros_beside(self, vector: FloatArray, j: int) -> tuple[Macro, Macro]:
        """Return the models one step of parameter j above a vector and one below."""
        above, below = vector.copy(), vector.copy()
        above[j] += self.space.parameters[j].step
        below[j] -= self.space.parameters[j].step
        return self.space.macro(above), self.space.macro(below)

    def _traced_derivative(self, solution: Solution, parameter: Parameter) -> FloatArray:
        """Return d beta / d theta of one quasar image, zero for the others [n_quasars, 2]."""
        out = np.zeros_like(solution.quasar_sources)
        shift = np.zeros((2, 2))
        shift[parameter.element] = (_QUASAR_STEP, -_QUASAR_STEP)
        points = solution.macro.quasars[parameter.component][:, None] + shift
        traced = points - self._deflection(solution.macro, *points)
        out[parameter.component] = (traced[:, 0] - traced[:, 1]) / (2.0 * _QUASAR_STEP)
        return out

    def _point_derivative(self, solution: Solution, parameter: Parameter, psf: FloatArray) -> FloatArray:
        shift = np.zeros(2)
        shift[parameter.element] = _QUASAR_STEP
        position = solution.macro.quasars[parameter.component]
        up, down = (point_source(psf, self.grid, *(position + s)) for s in (shift, -shift))
        return (up - down) / (2.0 * _QUASAR_STEP)


def _about_mean(points: FloatArray) -> FloatArray:
    """Return the points less their mean along the first axis, of which there may be none."""
    return points - points.mean(axis=0) if len(points) else points
