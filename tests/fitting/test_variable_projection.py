"""The fit of the lens to an image made from the model's own columns: truth, errors, convergence, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from warmlens.fitting.image_model import FitBand, ImageModel, SourceBasis
from warmlens.fitting.parameters import Macro, ParameterSpace, free_parameters, quasar_parameters
from warmlens.fitting.variable_projection import covariance, fit_parameters, tempered
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import hst_like_psf
from warmlens.imaging.shapelets import surface_brightness
from warmlens.types import FloatArray

GRID = PixelGrid.centred((64, 64), 0.055)
LENSES, LIGHTS = ("EPL", "SHEAR"), ("SERSIC",)
TRUTH = Macro(
    (
        {"theta_E": 1.0, "gamma": 2.05, "e1": 0.12, "e2": 0.05, "center_x": 0.01, "center_y": -0.02},
        {"gamma1": 0.06, "gamma2": 0.02, "ra_0": 0.0, "dec_0": 0.0},
    ),
    ({"R_sersic": 0.3, "n_sersic": 1.5, "center_x": 0.013, "center_y": -0.017},),
    np.empty((0, 2)),
    0.15,
)
LENS_FREE: list[dict[str, tuple[float, float, float | None]]] = [
    {"theta_E": (0.7, 1.3, None), "gamma": (1.5, 2.5, None), "e1": (-0.4, 0.4, None), "e2": (-0.4, 0.4, None)},
    {"gamma1": (-0.4, 0.4, None), "gamma2": (-0.4, 0.4, None)},
]
LIGHT_FREE: list[dict[str, tuple[float, float, float | None]]] = [
    {"R_sersic": (0.05, 1.5, None), "n_sersic": (0.3, 6.0, None)}
]
SOURCE = SourceBasis(6, (0.05, 0.02))
SIGMA = 0.02


def blank(lens_free: list[dict[str, tuple[float, float, float | None]]]) -> ImageModel:
    """The model at the truth, in front of empty images."""
    parameters = free_parameters("lens", TRUTH.kwargs_lens, lens_free)
    parameters += free_parameters("light", TRUTH.kwargs_light, LIGHT_FREE)
    bands = tuple(
        FitBand(name, np.zeros(GRID.shape), np.full(GRID.shape, 1.0 / SIGMA), hst_like_psf(wave, 0.055, 15))
        for name, wave in (("red", 814.0), ("blue", 600.0))
    )
    return ImageModel(
        grid=GRID, bands=bands, space=ParameterSpace(TRUTH, tuple(parameters)), lens_models=LENSES,
        light_models=LIGHTS, basis=SOURCE, supersampling=1, fit_background=True, ridge=1e-10, tie_arcsec=np.inf,
    )  # fmt: skip


def observed(model: ImageModel, seed: int | None) -> ImageModel:
    """With the truth's image, noisy or (seed None) not; the source is of an order that the basis holds."""
    solution = model.solve(model.space.start)
    rng = np.random.default_rng(3)
    bands: list[FitBand] = []
    for band, solved, convolution, flux in zip(
        model.bands, solution.bands, model.convolutions, (1.0, 0.6), strict=True
    ):
        coefficients = 0.2 * rng.normal(size=28)
        coefficients[0] = 3.0
        light = surface_brightness(solution.sets, flux * coefficients, solution.source_x, solution.source_y)
        image = convolution.forward(light.mean(axis=-1).reshape(GRID.shape))
        image += np.tensordot((60.0 * flux, 0.05), solved.fixed, axes=1)
        if seed is not None:
            image += SIGMA * np.random.default_rng((seed, len(bands))).normal(size=GRID.shape)
        bands.append(replace(band, image=image))
    return replace(model, bands=tuple(bands))


@pytest.fixture(scope="module")
def model() -> ImageModel:
    return observed(blank(LENS_FREE), 1)


def away(model: ImageModel) -> FloatArray:
    """5 per cent off in every parameter, up and down in turn."""
    return model.space.start * (1.0 + 0.05 * (-1.0) ** np.arange(model.space.start.size))


@pytest.fixture(scope="module")
def outcome(model: ImageModel):  # type: ignore[no-untyped-def]
    return fit_parameters(model, away(model), 15, 1e-6, "test")


def test_truth_is_recovered(model, outcome) -> None:  # type: ignore[no-untyped-def]
    """Within 3 of its own errors; the start was 100s of them away."""
    assert outcome.converged and 1 < outcome.steps < 15
    error = np.sqrt(np.diag(covariance(model, outcome.solution)))
    pull = (outcome.solution.vector - model.space.start) / error
    assert np.abs(pull).max() < 3.0, dict(zip(model.space.names, pull, strict=True))
    assert np.abs((away(model) - model.space.start) / error).max() > 100.0
    freedom = outcome.solution.n_pixels - 2 * 30 - pull.size
    assert outcome.solution.chi2 / freedom == pytest.approx(1.0, abs=3.0 * np.sqrt(2.0 / freedom))
    assert model.solve(away(model)).chi2 > 1.5 * outcome.solution.chi2


def test_without_noise_the_truth_is_exact(model: ImageModel) -> None:
    clean = observed(blank(LENS_FREE), None)
    best = fit_parameters(clean, away(clean), 30, 1e-12, "test").solution
    assert best.chi2 < 1e-6 * clean.solve(away(clean)).chi2
    np.testing.assert_allclose(best.vector, clean.space.start, rtol=0, atol=1e-4)


def test_covariance_is_the_scatter_of_fits(model, outcome) -> None:  # type: ignore[no-untyped-def]
    """Of 12 noise draws: each parameter's scatter within a factor 2 of its error (12 draws know it to 20%)."""
    draws = []
    for seed in range(12):
        drawn = observed(blank(LENS_FREE), 100 + seed)
        draws.append(fit_parameters(drawn, drawn.space.start, 6, 1e-5, "test").solution.vector)
    scatter = np.std(draws, axis=0, ddof=1)
    ratio = scatter / np.sqrt(np.diag(covariance(model, outcome.solution)))
    assert np.all((ratio > 0.5) & (ratio < 2.0)), dict(zip(model.space.names, ratio, strict=True))
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=0.25)


def test_covariance_holds_the_priors(model, outcome) -> None:  # type: ignore[no-untyped-def]
    """A prior of the size of the error halves the variance of its parameter; a wide one is no news."""
    free = covariance(model, outcome.solution)
    error = float(np.sqrt(free[1, 1]))
    for sigma, factor in ((error, 0.5), (100.0 * error, 1.0)):
        parameters = list(model.space.parameters)
        parameters[1] = replace(parameters[1], sigma=sigma)
        held = replace(model, space=replace(model.space, parameters=tuple(parameters)))
        assert covariance(held, outcome.solution)[1, 1] == pytest.approx(factor * free[1, 1], rel=1e-3)


def test_steps_that_run_out_are_no_convergence(model: ImageModel) -> None:
    short = fit_parameters(model, away(model), 1, 1e-6, "test")
    assert not short.converged
    assert short.steps == 1
    assert "maximum number" in short.message
    assert fit_parameters(model, away(model), 15, 0.5, "loose").converged


def test_fit_stops_at_a_limit(model: ImageModel) -> None:
    """The truth lies beyond: the fit stays inside and the space tells which limit it hit."""
    parameters = list(model.space.parameters)
    parameters[0] = replace(parameters[0], start=0.9, upper=0.95)
    boxed = replace(model, space=replace(model.space, parameters=tuple(parameters)))
    best = fit_parameters(boxed, boxed.space.start, 10, 1e-4, "test").solution
    hit = boxed.space.at_limit(best.vector)
    assert hit[0] and best.vector[0] < 0.95
    assert best.chi2 > 1.2 * model.solve(model.space.start).chi2
    outside = away(model)
    outside[0] = 5.0  # a start outside of the limits is taken to the nearest
    assert fit_parameters(boxed, outside, 1, 1e-4, "test").solution.vector[0] == pytest.approx(0.95, abs=1e-3)


def test_the_quasars_tie_fixes_the_lens() -> None:
    """With blank weights on the arcs' details (an image of noise alone) only tie and positions know theta_E."""
    quasars = np.array([[0.9, 0.3], [-0.8, -0.35]])
    model = blank(LENS_FREE)
    parameters = (*model.space.parameters[:1], *quasar_parameters(quasars, 0.005))
    noise = np.random.default_rng(5)
    bands = tuple(replace(b, image=SIGMA * noise.normal(size=GRID.shape)) for b in model.bands)
    tied = replace(model, bands=bands, tie_arcsec=0.003,
                   space=ParameterSpace(replace(TRUTH, quasars=quasars), parameters))  # fmt: skip
    best = fit_parameters(tied, tied.space.start, 20, 1e-6, "test").solution
    apart = np.ptp(best.quasar_sources, axis=0)
    assert np.hypot(*np.ptp(tied.solve(tied.space.start).quasar_sources, axis=0)) > 10.0 * np.hypot(*apart)


def test_tempered_is_the_size_of_the_residuals(model: ImageModel) -> None:
    start = away(model)
    solution = model.solve(start)
    hot = tempered(model, start)
    assert hot.temperature == pytest.approx(np.sqrt(solution.chi2 / solution.n_pixels)) and hot.temperature > 1.2
    pixels = hot.residuals(solution)[: solution.n_pixels]
    assert np.mean(pixels**2) == pytest.approx(1.0)
    quiet = replace(model, bands=tuple(replace(b, weights=0.1 * b.weights) for b in model.bands))
    assert tempered(quiet, start).temperature == 1.0  # never below the noise


def test_a_parameter_without_effect_is_refused(model: ImageModel) -> None:
    """The centre of a light that follows a lens changes nothing; a prior on it determines it."""
    light = [{"R_sersic": (0.05, 1.5, None), "center_x": (-0.3, 0.3, None)}]
    parameters = (*model.space.parameters[:1], *free_parameters("light", TRUTH.kwargs_light, light))
    followed = replace(model, space=ParameterSpace(TRUTH, parameters, ((0, 0),)))
    with pytest.raises(ValueError, match=r"do not determine all parameters; give .* prior width, or free fewer"):
        covariance(followed, followed.solve(followed.space.start))
    held = (*parameters[:2], replace(parameters[2], sigma=0.01))
    followed = replace(followed, space=replace(followed.space, parameters=held))
    assert covariance(followed, followed.solve(followed.space.start))[2, 2] == pytest.approx(1e-4, rel=1e-6)


def test_a_direction_without_effect_is_refused_in_spite_of_rounding(model: ImageModel) -> None:
    """Where the shear is 0 shifts the whole source plane; a source that is tied to the quasars moves along."""
    quasars = np.array([[0.776, -0.771], [-0.761, 0.731], [-0.971, -0.412], [0.449, 1.021]])
    free = [{"theta_E": (0.7, 1.3, None)}, {"ra_0": (-1.0, 1.0, None)}]
    space = ParameterSpace(
        replace(TRUTH, quasars=quasars),
        tuple(free_parameters("lens", TRUTH.kwargs_lens, free)),
    )
    moving = replace(model, space=space, basis=replace(SOURCE, center=None), tie_arcsec=0.003)
    with pytest.raises(ValueError, match="do not determine all parameters"):
        covariance(moving, moving.solve(space.start))
