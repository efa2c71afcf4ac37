"""Fit of the smooth lens to an observation, as the configuration asks for it.

Swarm, rising order of the source, PSF, clumps, and a last fit to convergence: every step starts where the one
before ended. Until the PSF is improved, the surroundings of the quasar images are left out. A lens that is given
needs only its noise, amplitudes and clumps.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace

import numpy as np

from warmlens.config.smooth_model import FitBlock, PsfFitBlock, SmoothModelBlock
from warmlens.fitting.clumps import find_clumps
from warmlens.fitting.image_model import FitBand, ImageModel, Solution, SourceBasis
from warmlens.fitting.parameters import (
    POTENTIAL_SHAPELETS,
    Macro,
    ParameterSpace,
    beta_parameter,
    free_parameters,
    quasar_parameters,
    shapelet_parameters,
)
from warmlens.fitting.psf_correction import PsfError, corrected_psf, psf_error, smooth_wings
from warmlens.fitting.search import particle_swarm
from warmlens.fitting.variable_projection import fit_parameters, tempered
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.observation import Observation
from warmlens.imaging.psf import point_source
from warmlens.sampling import stream
from warmlens.types import BoolArray, FloatArray

log = logging.getLogger(__name__)

_FIRST_CORRECTIONS = 3  # of the PSF before the lens moves again: the first one is the large one


@dataclass(frozen=True)
class FitStep:
    """One line of the history of a fit."""

    name: str
    n_max: int
    n_clumps: int
    chi2_per_pixel: float
    evaluations: int
    converged: bool
    seconds: float


@dataclass(frozen=True)
class LensFit:
    """A solved model and how it came about.

    Attributes
    ----------
    model, solution
        Model with its final PSF, noise and source basis, and its best parameters.
    noise
        Noise of each band without the error of its PSF [ny, nx] [e-/s], inf where masked.
    outside_cores
        Pixels that are not in the core of a quasar image [ny, nx].
    converged
        Whether the last fit stood still before its steps ran out; True for a given lens.
    psf_errors
        Error left in the PSF of each band; None where the PSF is taken as given.
    """

    model: ImageModel
    solution: Solution
    noise: tuple[FloatArray, ...]
    outside_cores: BoolArray
    converged: bool
    psf_errors: tuple[PsfError, ...] | None
    history: tuple[FitStep, ...]


def fit_lens(block: SmoothModelBlock, observed: Observation) -> LensFit:
    """Fit the lens from the start that the configuration gives, or take it from there if `mode` is `given`."""
    state = _FitState(block, observed)
    if block.mode == "given":
        state.set_noise()
        state.add_clumps()
        return state.result(converged=True)
    fit = block.fit
    assert fit is not None  # config: mode fit comes with its block
    state.raise_order(fit)
    if fit.psf is not None:
        for number in range(fit.psf.iterations):
            state.correct_psf(fit.psf, _FIRST_CORRECTIONS if number == 0 else 1)
            state.minimise(f"PSF {number + 1} of {fit.psf.iterations}", fit.max_steps, fit.tolerance)
    if block.source.clumps is not None:
        state.add_clumps()
        state.minimise("clumps", fit.max_steps, fit.tolerance)
        if fit.psf is not None:
            state.correct_psf(fit.psf, 1)
    if fit.psf is not None:
        state.measure_psf_error(fit.psf)
    state.set_noise()
    return state.result(converged=state.minimise("last fit", 2 * fit.max_steps, fit.tolerance))


class _FitState:
    """A fit under way: the model so far, solved, and the steps that change it."""

    def __init__(self, block: SmoothModelBlock, observed: Observation) -> None:
        self.block, self.observed = block, observed
        self.psf_errors: tuple[PsfError, ...] | None = None
        self.left_out: list[BoolArray] | None = None  # pixels of each band [ny, nx] whose PSF is not known yet
        self.history: list[FitStep] = []
        self.model = first_model(block, observed)
        self.solution = self.model.solve(self.model.space.start)

    def result(self, converged: bool) -> LensFit:
        noise = tuple(self._noise(i) for i in range(len(self.model.bands)))
        outside, history = self._outside_cores(), tuple(self.history)
        return LensFit(self.model, self.solution, noise, outside, converged, self.psf_errors, history)

    def _set_model(self, model: ImageModel, vector: FloatArray | None = None) -> None:
        self.model = model
        self.solution = model.solve(self.solution.vector if vector is None else vector)

    def _with_order(self, n_max: int) -> ImageModel:
        return replace(self.model, basis=replace(self.model.basis, n_max=n_max))

    def raise_order(self, fit: FitBlock) -> None:
        """Search with a swarm on the smallest source, then fit rising orders of the source, misfit tempered."""
        if fit.psf is not None:  # the fluxes of a first solution show where the PSF matters
            fraction = fit.psf.unknown_fraction
            lights = [self._quasar_light(i)[0] for i in range(len(self.model.bands))]
            pairs = zip(lights, self.model.bands, strict=True)
            self.left_out = [fraction * light * band.weights > 1.0 for light, band in pairs]
        vector = self.model.space.start
        self.set_noise()
        if fit.search is not None:
            small = tempered(self._with_order(fit.search.n_max), vector)
            lens = [p.kind == "lens" and p.element is None for p in self.model.space.parameters]
            rng = stream(fit.seed, "smooth_model", 0)
            vector = particle_swarm(small, fit.search.particles, fit.search.iterations, np.array(lens), rng)
        for n_max in (*fit.levels, self.block.source.n_max):
            self._set_model(self._with_order(n_max), vector)
            self.minimise(f"n_max {n_max}", fit.max_steps, fit.tolerance, temper=True)
            self.set_noise()
            vector = self.solution.vector
        self.left_out = None

    def minimise(self, name: str, max_steps: int, tolerance: float, temper: bool = False) -> bool:
        """Fit the parameters from where they are; return whether that converged."""
        begin = time.monotonic()
        model = tempered(self.model, self.solution.vector) if temper else self.model
        outcome = fit_parameters(model, self.solution.vector, max_steps, tolerance, name)
        self.solution = outcome.solution
        chi2 = self.solution.chi2 / self.solution.n_pixels
        log.info("%s: chi2 per pixel %.4f, %s", name, chi2, outcome.message)
        basis, seconds = self.model.basis, time.monotonic() - begin
        self.history.append(
            FitStep(name, basis.n_max, len(basis.clumps), chi2, outcome.steps, outcome.converged, seconds)
        )
        return outcome.converged

    def correct_psf(self, psf: PsfFitBlock, times: int) -> None:
        """Correct the PSF of every band on the quasar images, whose cores take part from now on."""
        for _ in range(times):
            self.set_noise()
            bands = []
            for i, band in enumerate(self.model.bands):
                kernel = corrected_psf(self.model, self.solution, i, psf.radius_arcsec, psf.relative_sigma)
                bands.append(replace(band, psf=kernel))
            self._set_model(replace(self.model, bands=tuple(bands)))
        self.set_noise()

    def measure_psf_error(self, psf: PsfFitBlock) -> None:
        """Replace the assumed error of the PSF by the measured one, from the next `set_noise` on."""
        self.psf_errors = tuple(
            psf_error(self.model, self.solution, i, self._noise(i), psf.radius_arcsec)
            for i in range(len(self.model.bands))
        )

    def add_clumps(self) -> None:
        """Add a shapelet set to the source for each feature of the residuals."""
        clumps = self.block.source.clumps
        if clumps is None or not clumps.number:
            return
        sets = find_clumps(self.model, self.solution, clumps, ~self._outside_cores())
        log.info("%d clumps (at most %d) above %g sigma", len(sets), clumps.number, clumps.threshold)
        self._set_model(replace(self.model, basis=replace(self.model.basis, clumps=sets)))

    def set_noise(self) -> None:
        """Set the noise of the model as it is now, and the error of the PSF near the quasars."""
        usable = usable_pixels(self.block, self.model.grid)
        bands = []
        for i, (band, data) in enumerate(zip(self.model.bands, self.observed.bands, strict=True)):
            light, fluxes = self._quasar_light(i)
            if self.psf_errors is None:
                extra = (self.block.quasar_variance_fraction * light) ** 2
            else:
                extra = self.psf_errors[i].variance(self.model.grid, self.solution.macro.quasars, fluxes)
            used = data.mask & usable if self.left_out is None else data.mask & usable & ~self.left_out[i]
            weights = np.where(used, 1.0 / np.sqrt(self._noise(i) ** 2 + extra), 0.0)
            bands.append(replace(band, weights=weights))
        self._set_model(replace(self.model, bands=tuple(bands)))

    def _noise(self, i: int) -> FloatArray:
        """Return the noise of band i [ny, nx] [e-/s], inf where masked: of the model's image, or as observed.

        Poisson noise estimated from the data themselves is too small wherever the noise is negative, which pulls
        every fit down; and the mocks have no such thing. Pixels that the fit leaves out keep the noise of their
        data.
        """
        data, solved = self.observed.bands[i], self.solution.bands[i]
        if self.block.noise_from == "data" or data.noise.background_rms is None:
            return data.sigma
        image = data.image.ravel().copy()
        image[solved.pixels] -= solved.residual / self.model.bands[i].weights.ravel()[solved.pixels]
        return np.where(data.mask, data.noise.sigma(image.reshape(data.image.shape)), np.inf)

    def _quasar_light(self, i: int) -> tuple[FloatArray, FloatArray]:
        """Return the image of the point sources of band i [ny, nx], and their fluxes [n_quasars]."""
        quasars, grid, psf = self.solution.macro.quasars, self.model.grid, self.model.bands[i].psf
        fluxes = self.solution.bands[i].fixed_amplitudes[: len(quasars)]
        images = [flux * point_source(psf, grid, x, y) for flux, (x, y) in zip(fluxes, quasars, strict=True)]
        return np.sum(images, axis=0) if images else np.zeros(grid.shape), fluxes

    def _outside_cores(self) -> BoolArray:
        return outside_cores(self.block, self.model.grid, self.solution.macro.quasars)


def first_model(block: SmoothModelBlock, observed: Observation) -> ImageModel:
    """Return the model at the start of the configuration; nothing is free if `mode` is `given`."""
    fit = block.fit if block.mode == "fit" else None
    quasars = np.array(block.quasar_images, dtype=np.float64).reshape(-1, 2)
    lens = block.lens if fit is None else block.fitted_lens
    names, kwargs = tuple(lens.lens_model_list), tuple(lens.kwargs_lens)
    light, source = block.lens_light, block.source
    parameters = []
    if fit is not None:
        parameters += free_parameters("lens", kwargs, fit.lens_free)
        potential = fit.potential_shapelets
        if potential.number:
            zeros = [0.0] * potential.number
            middle = {key: kwargs[0].get(key, 0.0) for key in ("center_x", "center_y")}
            names = (*names, POTENTIAL_SHAPELETS)
            kwargs = (*kwargs, {"beta": potential.beta_arcsec, **middle, "coeffs": zeros})
            parameters += shapelet_parameters(len(names) - 1, zeros, potential.sigma)
        parameters += free_parameters("light", light.kwargs_lens_light, fit.lens_light_free)
        parameters += quasar_parameters(quasars, fit.quasar_sigma_arcsec)
        if fit.source_beta is not None:
            parameters.append(beta_parameter(source.beta_arcsec, fit.source_beta))
    macro = Macro(kwargs, tuple(light.kwargs_lens_light), quasars, source.beta_arcsec)
    order = source.n_max if fit is None or not fit.levels else fit.levels[0]
    return ImageModel(
        grid=observed.grid,
        bands=_first_bands(block, observed, fit.psf if fit else None),
        space=ParameterSpace(macro, tuple(parameters), tuple(fit.satellites) if fit else ()),
        lens_models=names,
        light_models=tuple(light.lens_light_model_list),
        basis=SourceBasis(order, None if source.center == "quasars" else source.center),
        supersampling=source.supersampling,
        fit_background=block.fit_background,
        ridge=block.ridge,
        tie_arcsec=fit.tie_arcsec if fit else np.inf,
    )


def _first_bands(block: SmoothModelBlock, observed: Observation, psf: PsfFitBlock | None) -> tuple[FitBand, ...]:
    """Return the bands with the noise of the data, and smooth wings of a PSF that will be corrected."""
    usable, scale = usable_pixels(block, observed.grid), observed.grid.pixel_scale
    bands = []
    for band in observed.bands:
        kernel = band.psf if psf is None else smooth_wings(band.psf, scale, *psf.wing_radii_arcsec)
        bands.append(FitBand(band.name, band.image, np.where(usable, band.weights, 0.0), kernel))
    return tuple(bands)


def usable_pixels(block: SmoothModelBlock, grid: PixelGrid) -> BoolArray:
    """Return the pixels within the disc of the fit and outside the masked core of the lens [ny, nx]."""
    kwargs = block.lens.kwargs_lens[0] if block.lens.kwargs_lens else {}
    x, y = grid.coordinates()
    distance = np.hypot(x - kwargs.get("center_x", 0.0), y - kwargs.get("center_y", 0.0)).round(
        9
    )  # ties stay ties
    outer = np.inf if block.disc_arcsec is None else block.disc_arcsec
    return (distance <= outer) & (distance >= block.lens_core_mask_arcsec)


def outside_cores(block: SmoothModelBlock, grid: PixelGrid, quasars: FloatArray) -> BoolArray:
    """Return the pixels [ny, nx] farther than `quasar_core_arcsec` from every quasar image at positions [n, 2]."""
    x, y = grid.coordinates()
    near = [np.hypot(x - qx, y - qy).round(9) < block.quasar_core_arcsec for qx, qy in quasars]
    return ~np.any(near, axis=0) if near else np.ones(grid.shape, dtype=bool)
