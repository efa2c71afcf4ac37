"""Shapelets: orthonormality, order, sub-pixel averages, brightness without the matrix."""

import numpy as np
import pytest

from warmlens.imaging.shapelets import (
    ShapeletSet,
    basis,
    n_coefficients,
    pixel_basis,
    surface_brightness,
)

TWO_SETS = (ShapeletSet(6, 0.2, 0.1, -0.05), ShapeletSet(2, 0.05, -0.3, 0.2))


@pytest.fixture
def rays():
    return np.random.default_rng(3).normal(0.0, 0.4, (2, 130, 4))


def test_orthonormal_at_the_orders_of_the_paper():
    """Trapezoids are spectrally accurate for these functions; the norm is beta^2 (see the module)."""
    shapelets = ShapeletSet(50, 0.2, 0.0, 0.0)
    step = 0.04
    axis = np.arange(-75, 76) * step
    x, y = (array.ravel() for array in np.meshgrid(axis, axis))
    values = basis([shapelets], x, y)
    gram = values.T @ values * step**2 / shapelets.beta**2
    np.testing.assert_allclose(gram, np.eye(shapelets.n_coefficients), atol=1e-10)


def test_order_of_the_functions():
    """By total order, n1 falling: at y = 0 an odd n2 vanishes, at x = 0 an odd n1."""
    shapelets = ShapeletSet(3, 0.3, 0.0, 0.0)
    assert shapelets.orders()[:6] == ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    assert len(shapelets.orders()) == shapelets.n_coefficients == 10
    on_x, on_y = basis([shapelets], np.array([0.11, 0.0]), np.array([0.0, 0.11]))
    for index, (n1, n2) in enumerate(shapelets.orders()):
        assert (on_x[index] == 0.0) == (n2 % 2 == 1)
        assert (on_y[index] == 0.0) == (n1 % 2 == 1)


def test_sets_follow_one_another(rays):
    x, y = rays[:, :, 0]
    both = basis(TWO_SETS, x, y)
    assert both.shape == (130, n_coefficients(TWO_SETS)) == (130, 28 + 6)
    np.testing.assert_array_equal(both[:, :28], basis(TWO_SETS[:1], x, y))
    np.testing.assert_array_equal(both[:, 28:], basis(TWO_SETS[1:], x, y))


@pytest.mark.parametrize("n_sub", [1, 4, 9])
def test_pixel_basis_is_the_mean_over_sub_pixels(n_sub):
    x, y = np.random.default_rng(4).normal(0.0, 0.3, (2, 70, n_sub))
    expected = np.mean([basis(TWO_SETS, x[:, s], y[:, s]) for s in range(n_sub)], axis=0)
    np.testing.assert_allclose(pixel_basis(TWO_SETS, x, y), expected, rtol=0, atol=1e-14)


def test_surface_brightness_is_basis_times_coefficients(rays):
    coefficients = np.random.default_rng(5).normal(size=n_coefficients(TWO_SETS))
    x, y = rays
    expected = basis(TWO_SETS, x.ravel(), y.ravel()) @ coefficients
    values = surface_brightness(TWO_SETS, coefficients, x, y)
    assert values.shape == x.shape
    np.testing.assert_allclose(values.ravel(), expected, rtol=0, atol=1e-13)


def test_far_rays_are_dark_and_finite():
    values = basis([ShapeletSet(50, 0.18, 0.0, 0.0)], np.array([40.0, -1e6]), np.array([0.0, 3.0]))
    np.testing.assert_array_equal(values, 0.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((-1, 0.2, 0.0, 0.0), "smooth_model.source.n_max"),
        ((3, 0.0, 0.0, 0.0), "smooth_model.source.beta_arcsec"),
        ((3, np.nan, 0.0, 0.0), "smooth_model.source.beta_arcsec"),
        ((3, 0.2, np.inf, 0.0), "centre"),
    ],
)
def test_impossible_sets_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        ShapeletSet(*arguments)


def test_wrong_shapes_are_refused(rays):
    x, y = rays
    with pytest.raises(ValueError, match="share"):
        pixel_basis(TWO_SETS, x, y[:-1])
    with pytest.raises(ValueError, match="34 coefficients"):
        surface_brightness(TWO_SETS, np.zeros(33), x, y)
    with pytest.raises(ValueError, match="at least one"):
        basis((), x[:, 0], y[:, 0])


def test_clumps_far_from_most_rays():
    """Rays beyond a clump's reach are left out; what is left out is nothing, near and far."""
    sets = (ShapeletSet(12, 0.2, 0.0, 0.0), *(ShapeletSet(3, 0.02, 0.1 * i - 0.7, 0.05 * i) for i in range(15)))
    coefficients = np.random.default_rng(6).normal(size=n_coefficients(sets))
    x, y = np.random.default_rng(7).uniform(-3.0, 3.0, (2, 5000))
    x[:200], y[:200] = x[:200] * 0.1, y[:200] * 0.1 + 0.3
    expected = basis(sets, x, y) @ coefficients
    np.testing.assert_allclose(surface_brightness(sets, coefficients, x, y), expected, rtol=0, atol=1e-13)
    clump = sets[-1]
    edge = clump.center_x + clump.beta * (np.sqrt(7.0) + np.array([5.0, 7.99, 8.01]))
    values = surface_brightness([clump], np.ones(10), edge, np.full(3, clump.center_y))
    assert values[0] != 0.0 and values[1] != 0.0 and values[2] == 0.0
    assert abs(values[1]) < 1e-15


def test_a_ray_that_is_no_number_is_not_dark():
    values = surface_brightness([ShapeletSet(3, 0.1, 0.0, 0.0)], np.ones(10), np.array([np.nan, 0.1]), np.zeros(2))
    assert np.isnan(values[0]) and np.isfinite(values[1])
