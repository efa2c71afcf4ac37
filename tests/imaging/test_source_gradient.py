"""Gradient of the source: central differences, and lenstronomy's own brightness."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from warmlens.imaging.shapelets import ShapeletSet, n_coefficients, surface_brightness
from warmlens.imaging.source_gradient import source_gradient
from warmlens.types import FloatArray

STEP = 1e-5
CASES = {
    "constant order": (ShapeletSet(0, 0.3, 0.1, -0.2),),
    "one set": (ShapeletSet(9, 0.2, 0.1, -0.05),),
    "three sets": (
        ShapeletSet(6, 0.2, 0.1, -0.05),
        ShapeletSet(0, 0.1, 0.2, 0.2),
        ShapeletSet(3, 0.05, -0.3, 0.2),
    ),
    "paper's order": (ShapeletSet(50, 0.18, -0.5, -0.06),),
}


@pytest.fixture
def rays() -> FloatArray:
    return np.random.default_rng(3).normal(0.0, 0.3, (2, 90, 4))


def differences(
    function: Callable[[FloatArray, FloatArray], FloatArray], x: FloatArray, y: FloatArray
) -> list[FloatArray]:
    """Fourth-order central differences along x and y."""
    steps = ((STEP, 0.0), (0.0, STEP))
    return [
        (8.0 * (function(x + a, y + b) - function(x - a, y - b))
         - (function(x + 2 * a, y + 2 * b) - function(x - 2 * a, y - 2 * b))) / (12.0 * STEP)
        for a, b in steps
    ]  # fmt: skip


@pytest.mark.parametrize("name", list(CASES))
def test_gradient_is_the_difference_of_the_brightness(name: str, rays: FloatArray) -> None:
    sets = CASES[name]
    coefficients = np.random.default_rng(4).normal(size=n_coefficients(sets))
    gradient = source_gradient(sets, coefficients, *rays)
    expected = differences(lambda x, y: surface_brightness(sets, coefficients, x, y), *rays)
    for ours, theirs in zip(gradient, expected, strict=True):
        assert ours.shape == rays[0].shape
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-8 * np.abs(theirs).max())


def test_gradient_of_lenstronomy_s_source(rays: FloatArray) -> None:
    from lenstronomy.LightModel.light_model import LightModel

    shapelets = ShapeletSet(8, 0.18, -0.1, 0.06)
    coefficients = np.random.default_rng(5).normal(size=shapelets.n_coefficients)
    kwargs = {"amp": coefficients, "n_max": 8, "beta": 0.18, "center_x": -0.1, "center_y": 0.06}
    model = LightModel(["SHAPELETS"])
    x, y = (axis.ravel() for axis in rays)
    expected = differences(lambda u, v: model.surface_brightness(u, v, [kwargs]), x, y)
    for ours, theirs in zip(source_gradient([shapelets], coefficients, x, y), expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-8 * np.abs(theirs).max())


def test_gradient_is_linear_in_the_coefficients_and_separate_by_set(rays: FloatArray) -> None:
    """A set whose coefficients are 0 adds nothing: each set takes its own part of the vector."""
    sets = CASES["three sets"]
    coefficients = np.random.default_rng(6).normal(size=n_coefficients(sets))
    whole = np.array(source_gradient(sets, coefficients, *rays))
    parts, start = np.zeros_like(whole), 0
    for shapelets in sets:
        part = slice(start, start + shapelets.n_coefficients)
        parts += source_gradient([shapelets], coefficients[part], *rays)
        start = part.stop
    np.testing.assert_allclose(parts, whole, rtol=0, atol=1e-12 * np.abs(whole).max())
