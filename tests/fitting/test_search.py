"""The particle swarm: reproducible, without side effects, never worse than its start, and it finds the lens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from warmlens.fitting.image_model import FitBand, ImageModel, SourceBasis
from warmlens.fitting.parameters import Macro, ParameterSpace, free_parameters
from warmlens.fitting.search import particle_swarm
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import hst_like_psf
from warmlens.imaging.shapelets import surface_brightness
from warmlens.types import FloatArray

GRID = PixelGrid.centred((36, 36), 0.09)
SIGMA = 0.05
ALL = np.array([True, True, True, True])
TRUTH = np.array([1.0, 0.12, 0.05, 0.3])


def at(vector: FloatArray) -> ParameterSpace:
    """Space that starts at (theta_E, e1, e2 of an ellipsoid, R_sersic of its light)."""
    theta_e, e1, e2, radius = (float(value) for value in vector)
    lens = ({"theta_E": theta_e, "e1": e1, "e2": e2, "center_x": 0.01, "center_y": -0.02},)
    light = ({"R_sersic": radius, "n_sersic": 1.5, "center_x": 0.013, "center_y": -0.017},)
    free: dict[str, tuple[float, float, float | None]] = {
        "theta_E": (0.5, 1.5, None), "e1": (-0.3, 0.3, None), "e2": (-0.3, 0.3, None)
    }  # fmt: skip
    parameters = free_parameters("lens", lens, [free])
    parameters += free_parameters("light", light, [{"R_sersic": (0.05, 1.5, None)}])
    return ParameterSpace(Macro(lens, light, np.empty((0, 2)), 0.12), tuple(parameters))


@pytest.fixture(scope="module")
def model() -> ImageModel:
    """Noisy arcs of a source of order 2, with the truth's lens as the start."""
    band = FitBand("red", np.zeros(GRID.shape), np.full(GRID.shape, 1.0 / SIGMA), hst_like_psf(814.0, 0.09, 9))
    blank = ImageModel(
        grid=GRID, bands=(band,), space=at(TRUTH), lens_models=("SIE",), light_models=("SERSIC",),
        basis=SourceBasis(2, (0.06, 0.03)), supersampling=1, fit_background=False, ridge=1e-10,
        tie_arcsec=np.inf,
    )  # fmt: skip
    solution = blank.solve(TRUTH)
    coefficients = np.array([3.0, 0.3, -0.2, 0.1, 0.0, 0.2])
    light = surface_brightness(solution.sets, coefficients, solution.source_x, solution.source_y).mean(axis=-1)
    image = blank.convolutions[0].forward(light.reshape(GRID.shape)) + 30.0 * solution.bands[0].fixed[0]
    image += SIGMA * np.random.default_rng(1).normal(size=GRID.shape)
    return replace(blank, bands=(replace(band, image=image),))


def starting(model: ImageModel, vector: FloatArray) -> ImageModel:
    return replace(model, space=at(vector))


def search(model: ImageModel, seed: int, particles: int = 8, iterations: int = 3, searched=ALL) -> FloatArray:  # type: ignore[no-untyped-def]
    return particle_swarm(model, particles, iterations, searched, np.random.default_rng(seed))


FAR = np.array([1.4, -0.2, -0.2, 0.6])


def test_same_seed_same_swarm(model: ImageModel) -> None:
    far = starting(model, FAR)
    first = search(far, 5)
    np.random.seed(99)  # noqa: NPY002 - whatever others drew before
    np.testing.assert_array_equal(search(far, 5), first)
    assert np.any(search(far, 6) != first)


def test_global_generator_is_left_as_it_was(model: ImageModel) -> None:
    np.random.seed(4)  # noqa: NPY002
    expected = np.random.uniform(size=5)  # noqa: NPY002
    np.random.seed(4)  # noqa: NPY002
    search(starting(model, FAR), 5)
    np.testing.assert_array_equal(np.random.uniform(size=5), expected)  # noqa: NPY002


def test_global_generator_is_restored_after_an_error(model: ImageModel) -> None:
    np.random.seed(4)  # noqa: NPY002
    expected = np.random.uniform(size=5)  # noqa: NPY002
    np.random.seed(4)  # noqa: NPY002
    with pytest.raises((ValueError, IndexError)):
        search(model, 5, searched=np.array([True, False]))
    np.testing.assert_array_equal(np.random.uniform(size=5), expected)  # noqa: NPY002


def test_never_worse_than_the_start(model: ImageModel) -> None:
    """From the truth, which a swarm of four and one move does not beat: the start is handed back."""
    np.testing.assert_array_equal(search(model, 5, 4, 1), TRUTH)
    for seed in range(3):
        far = starting(model, FAR)
        assert far.solve(search(far, seed, 4, 1)).chi2 <= far.solve(FAR).chi2


def test_the_lens_is_found_from_far_off(model: ImageModel) -> None:
    """A start 40 per cent off in theta_E and with the ellipticity's sign turned."""
    far = starting(model, FAR)
    best = search(far, 5, 24, 25)
    per_pixel = far.solve(best).chi2 / GRID.ny / GRID.nx
    assert far.solve(FAR).chi2 / GRID.ny / GRID.nx > 10.0
    assert per_pixel < 1.5
    np.testing.assert_allclose(best[:3], TRUTH[:3], atol=0.05)


def test_only_what_is_searched_moves_and_within_limits(model: ImageModel) -> None:
    far = starting(model, FAR)
    best = search(far, 5, searched=np.array([True, True, True, False]))
    assert best[3] == FAR[3] and np.all(best[:3] != FAR[:3])
    lower, upper = far.space.limits
    assert np.all((lower < best) & (best < upper))


def test_priors_take_part(model: ImageModel) -> None:
    """A prior of 1e-4 about a wrong theta_E, and the swarm stays there: the posterior is searched, not chi2."""
    far = starting(model, FAR)
    held = (replace(far.space.parameters[0], sigma=1e-4), *far.space.parameters[1:])
    tight = replace(far, space=replace(far.space, parameters=held))
    assert search(tight, 5, 24, 8)[0] == pytest.approx(FAR[0], abs=0.02)
    assert search(far, 5, 24, 8)[0] < FAR[0] - 0.2
