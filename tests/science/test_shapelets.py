"""Shapelets against lenstronomy's SHAPELETS: same order, same normalisation, same values."""

import numpy as np
import pytest
from lenstronomy.LightModel.light_model import LightModel

from warmlens.imaging.shapelets import ShapeletSet, basis, surface_brightness


@pytest.mark.parametrize("n_max", [0, 1, 8, 50])
def test_values_are_lenstronomy_s(n_max):
    """To 1e-10 of the peak; lenstronomy sums explicit Hermite polynomials, here a recurrence."""
    rng = np.random.default_rng(n_max)
    shapelets = ShapeletSet(n_max, 0.18, -0.503, -0.058)
    x, y = rng.normal(-0.4, 0.6, (2, 60))
    coefficients = rng.normal(size=shapelets.n_coefficients)
    model = LightModel(["SHAPELETS"])
    parameters = {"n_max": n_max, "beta": 0.18, "center_x": -0.503, "center_y": -0.058}
    expected = model.surface_brightness(x, y, [parameters | {"amp": coefficients}])
    scale = np.abs(expected).max()
    np.testing.assert_allclose(
        surface_brightness([shapelets], coefficients, x, y), expected, rtol=0, atol=1e-10 * scale
    )
    single, _ = model.functions_split(x, y, [parameters | {"amp": np.ones(shapelets.n_coefficients)}])
    np.testing.assert_allclose(basis([shapelets], x, y), np.transpose(single), rtol=0, atol=1e-10)
