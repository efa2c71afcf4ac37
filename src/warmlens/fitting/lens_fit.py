"""Fit of the smooth lens to an observation, as the configuration asks for it.

Swarm, rising order of the source, PSF, clumps, and a last fit to convergence: every step starts where the one
before ended. Until the PSF is improved, the surroundings of the quasar images are left out.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from warmlens.config.smooth_model import ClumpsBlock, FitBlock, PsfFitBlock, SmoothModelBlock
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
from warmlens.imaging.observation import Band, Observation
from warmlens.imaging.psf import point_source
from warmlens.sampling import stream
from warmlens.types import BoolArray, FloatArray

log = logging.getLogger(__name__)

_FIRST_CORRECTIONS = 3  # of the PSF before the lens moves again: the first one is the large one


@dataclass(frozen=True)
class Step:
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
    converged
        Whether the last fit stood still before its steps ran out; True for a given lens.
    psf_errors
        Error left in the PSF of each band; None where the PSF is taken as given.
    history
        The steps.
    """

    model: ImageModel
    solution: Solution
    converged: bool
    psf_errors: tuple[PsfError, ...] | None
    history: tuple[Step, ...]


def solve_given(block: SmoothModelBlock, observed: Observation) -> LensFit:
    """Amplitudes, noise near the quasars and clumps on a given lens."""
    model = first_model(block, observed, None)
    solution = model.solve(model.space.start)
    model = with_noise(model, solution, block, observed)
    solution = model.solve(solution.vector)
    if block.source.clumps is not None:
        model = with_clumps(model, solution, block.source.clumps, block, observed)
        solution = model.solve(solution.vector)
    return LensFit(model, solution, True, None, ())


def fit_lens(block: SmoothModelBlock, observed: Observation) -> LensFit:
    """Fit the lens from the start that the configuration gives."""
    fit = block.fit
    assert fit is not None  # config: mode fit comes with its block
    work = _Work(block, fit, observed, first_model(block, observed, fit))
    work.search_and_levels()
    if fit.psf is not None:
        for number in range(fit.psf.iterations):
            work.correct_psf(_FIRST_CORRECTIONS if number == 0 else 1)
            work.fit(f"PSF {number + 1} of {fit.psf.iterations}", fit.max_steps)
    if block.source.clumps is not None:
        work.model = with_clumps(work.model, work.solution, block.source.clumps, block, observed)
        work.fit("clumps", fit.max_steps)
        if fit.psf is not None:
            work.correct_psf(1)
    if fit.psf is not None:
        work.measure_psf_error()
    else:
        work.weigh()
    converged = work.fit("last fit", 2 * fit.max_steps)
    return LensFit(work.model, work.solution, converged, work.psf_errors, tuple(work.history))


@dataclass
class _Work:
    """A fit under way: the model so far, its solution, and what was done."""

    block: SmoothModelBlock
    settings: FitBlock
    observed: Observation
    model: ImageModel
    psf_errors: tuple[PsfError, ...] | None = None
    hidden: list[BoolArray] | None = None
    history: list[Step] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.solution: Solution = self.model.solve(self.model.space.start)

    def search_and_levels(self) -> None:
        """Swarm on the smallest source, then rising orders of it, misfit tempered."""
        last = self.block.source.n_max
        search, psf = self.settings.search, self.settings.psf
        if psf is not None:  # the fluxes of a first solution tell where the PSF matters
            self.hidden = near_quasars(self.model, self.solution, psf.unknown_fraction)
        vector = self.model.space.start
        self.weigh()
        if search is not None:
            small = tempered(self._order(search.n_max), vector)
            lens = [p.kind == "lens" and p.element is None for p in self.model.space.parameters]
            rng = stream(self.settings.seed, "smooth_model", 0)
            vector = particle_swarm(small, search.particles, search.iterations, np.array(lens), rng)
        for n_max in (*self.settings.levels, last):
            self.model = self._order(n_max)
            self.solution = self.model.solve(vector)
            self.fit(f"n_max {n_max}", self.settings.max_steps, temper=True)
            self.weigh()
            vector = self.solution.vector
        self.hidden = None

    def weigh(self) -> None:
        """Noise of the model as it is now."""
        self.model = with_noise(self.model, self.solution, self.block, self.observed, self.psf_errors, self.hidden)
        self.solution = self.model.solve(self.solution.vector)

    def _order(self, n_max: int) -> ImageModel:
        return replace(self.model, basis=replace(self.model.basis, n_max=n_max))

    def fit(self, name: str, max_steps: int, temper: bool = False) -> bool:
        """Fit the parameters from where they are; whether that converged."""
        begin = time.monotonic()
        model = tempered(self.model, self.solution.vector) if temper else self.model
        outcome = fit_parameters(model, self.solution.vector, max_steps, self.settings.tolerance, name)
        self.solution = outcome.solution
        step = Step(
            name,
            self.model.basis.n_max,
            len(self.model.basis.clumps),
            self.solution.chi2 / self.solution.n_pixels,
            outcome.steps,
            outcome.converged,
            time.monotonic() - begin,
        )
        log.info("%s: chi2 per pixel %.4f, %s", name, step.chi2_per_pixel, outcome.message)
        self.history.append(step)
        return outcome.converged

    def correct_psf(self, times: int) -> None:
        """Correct the PSF of every band on the quasar images, and let the cores of these take part."""
        psf = self.settings.psf
        assert psf is not None
        for _ in range(times):
            self.weigh()
            kernels = [
                corrected_psf(self.model, self.solution, i, psf.radius_arcsec, psf.relative_sigma)
                for i in range(len(self.model.bands))
            ]
            pairs = zip(self.model.bands, kernels, strict=True)
            self.model = replace(self.model, bands=tuple(replace(band, psf=kernel) for band, kernel in pairs))
            self.solution = self.model.solve(self.solution.vector)
        self.weigh()

    def measure_psf_error(self) -> None:
        """Replace the assumed error of the PSF by the measured one."""
        psf = self.settings.psf
        assert psf is not None
        noise = [noise_sigma(self.model, self.solution, self.block, band) for band in self.observed.bands]
        self.psf_errors = tuple(
            psf_error(self.model, self.solution, i, sigma, psf.radius_arcsec) for i, sigma in enumerate(noise)
        )
        self.weigh()


def first_model(block: SmoothModelBlock, observed: Observation, fit: FitBlock | None) -> ImageModel:
    """Model at the start of the configuration; nothing is free without `fit`."""
    quasars = np.array(block.quasar_images, dtype=np.float64).reshape(-1, 2)
    lens = block.lens if fit is None else block.fitted_lens
    names, kwargs = tuple(lens.lens_model_list), tuple(lens.kwargs_lens)
    light = block.lens_light
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
            parameters.append(beta_parameter(block.source.beta_arcsec, fit.source_beta))
    source = block.source
    macro = Macro(kwargs, tuple(light.kwargs_lens_light), quasars, source.beta_arcsec)
    order = source.n_max if fit is None or not fit.levels else fit.levels[0]
    center = None if source.center == "quasars" else source.center
    return ImageModel(
        grid=observed.grid,
        bands=tuple(_first_band(block, observed.grid, band, fit.psf if fit else None) for band in observed.bands),
        space=ParameterSpace(macro, tuple(parameters), tuple(fit.satellites) if fit else ()),
        lens_models=names,
        light_models=tuple(light.lens_light_model_list),
        basis=SourceBasis(order, center),
        supersampling=source.supersampling,
        fit_background=block.fit_background,
        ridge=block.ridge,
        tie_arcsec=fit.tie_arcsec if fit else np.inf,
    )


def _first_band(block: SmoothModelBlock, grid: PixelGrid, band: Band, psf: PsfFitBlock | None) -> FitBand:
    kernel = band.psf if psf is None else smooth_wings(band.psf, grid.pixel_scale, *psf.wing_radii_arcsec)
    return FitBand(band.name, band.image, np.where(usable_pixels(block, grid), band.weights, 0.0), kernel)


def usable_pixels(block: SmoothModelBlock, grid: PixelGrid) -> BoolArray:
    """Pixels within the disc of the fit and outside the masked core of the lens [ny, nx]."""
    kwargs = block.lens.kwargs_lens[0] if block.lens.kwargs_lens else {}
    x, y = grid.coordinates()
    distance = np.hypot(x - kwargs.get("center_x", 0.0), y - kwargs.get("center_y", 0.0))
    outer = np.inf if block.disc_arcsec is None else block.disc_arcsec
    return (distance <= outer) & (distance >= block.lens_core_mask_arcsec)


def outside_cores(block: SmoothModelBlock, grid: PixelGrid, quasars: FloatArray) -> BoolArray:
    """Pixels farther than `quasar_core_arcsec` from every quasar image [ny, nx]."""
    x, y = grid.coordinates()
    near = [np.hypot(x - qx, y - qy) < block.quasar_core_arcsec for qx, qy in quasars]
    return ~np.any(near, axis=0) if near else np.ones(grid.shape, dtype=bool)


def quasar_light(model: ImageModel, solution: Solution, number: int) -> tuple[FloatArray, FloatArray]:
    """Image of the point sources of one band [ny, nx], and their fluxes [n_quasars]."""
    quasars = solution.macro.quasars
    fluxes = solution.bands[number].fixed_amplitudes[: len(quasars)]
    images = [
        flux * point_source(model.bands[number].psf, model.grid, x, y)
        for flux, (x, y) in zip(fluxes, quasars, strict=True)
    ]
    return np.sum(images, axis=0) if images else np.zeros(model.grid.shape), fluxes


def noise_sigma(model: ImageModel, solution: Solution, block: SmoothModelBlock, data: Band) -> FloatArray:
    """Noise of a band [ny, nx] [e-/s], inf where masked: of the model's image, or as it was observed.

    Poisson noise estimated from the data themselves is too small wherever the noise is negative, which pulls
    every fit down; and the mocks have no such thing. Pixels that the fit leaves out keep the noise of their data.
    """
    if block.noise_from == "data" or data.noise.background_rms is None:
        return data.sigma
    i = next(number for number, band in enumerate(model.bands) if band.name == data.name)
    solved = solution.bands[i]
    image = data.image.ravel().copy()
    image[solved.pixels] -= solved.residual / model.bands[i].weights.ravel()[solved.pixels]
    return np.where(data.mask, data.noise.sigma(image.reshape(data.image.shape)), np.inf)


def with_noise(
    model: ImageModel,
    solution: Solution,
    block: SmoothModelBlock,
    observed: Observation,
    errors: Sequence[PsfError] | None = None,
    hidden: Sequence[BoolArray] | None = None,
) -> ImageModel:
    """The model with its noise: the observation's, and the PSF's error near the quasars.

    Parameters
    ----------
    errors
        Error of each band's PSF where measured, else the fraction that the configuration assumes.
    hidden
        Pixels of each band that are left out [ny, nx].
    """
    usable = usable_pixels(block, model.grid)
    bands = []
    for i, (band, data) in enumerate(zip(model.bands, observed.bands, strict=True)):
        light, fluxes = quasar_light(model, solution, i)
        if errors is None:
            extra = (block.quasar_variance_fraction * light) ** 2
        else:
            extra = errors[i].variance(model.grid, solution.macro.quasars, fluxes)
        noise = noise_sigma(model, solution, block, data)
        seen = data.mask & usable if hidden is None else data.mask & usable & ~hidden[i]
        bands.append(replace(band, weights=np.where(seen, 1.0 / np.sqrt(noise**2 + extra), 0.0)))
    return replace(model, bands=tuple(bands))


def near_quasars(model: ImageModel, solution: Solution, fraction: float) -> list[BoolArray]:
    """Pixels of each band where `fraction` of the quasars' light exceeds the noise [ny, nx]."""
    lights = [quasar_light(model, solution, i)[0] for i in range(len(model.bands))]
    return [fraction * light * band.weights > 1.0 for light, band in zip(lights, model.bands, strict=True)]


def with_clumps(
    model: ImageModel,
    solution: Solution,
    clumps: ClumpsBlock,
    block: SmoothModelBlock,
    observed: Observation,
) -> ImageModel:
    """The model with a shapelet set on each residual feature."""
    if not clumps.number:
        return model
    excluded = ~outside_cores(block, observed.grid, solution.macro.quasars)
    found = find_clumps(
        model, solution, clumps.number, clumps.n_max, clumps.threshold, clumps.scale_in_fwhm, excluded
    )
    log.info("%d clumps (at most %d) above %g sigma", len(found), clumps.number, clumps.threshold)
    return replace(model, basis=replace(model.basis, clumps=found))
