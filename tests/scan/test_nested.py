"""Nested shapelets: where they lie, how large they are, on which rays they count."""

import numpy as np
import pytest

from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.shapelets import ShapeletSet, pixel_basis
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.nested import NestedShapelets, nested_basis, nested_block, nested_columns, nested_points
from warmlens.scan.perturber import Perturber

PAPER = Perturber(0.01, 0.1)
WIDE = NestedShapelets(5, 1e-5, (1e-4, 10.0))


def isothermal(factor=1, axes=((1.0, 0.0), (0.0, 1.0)), pixel_scale=0.05, theta_e=1.0):
    """Rays of a singular isothermal sphere: mu = 1 / (1 - theta_E / r)."""
    n = round(4.0 / pixel_scale)
    grid = PixelGrid(n, n, pixel_scale, *(-0.5 * (n - 1) * pixel_scale * np.sum(axes, axis=1)), axes)
    x, y = grid.subpixel_coordinates(factor)
    radius = np.hypot(x, y)
    return SmoothRays(x, y, x * (1.0 - theta_e / radius), y * (1.0 - theta_e / radius)), n


@pytest.mark.parametrize("axes", [((1.0, 0.0), (0.0, 1.0)), ((0.6, -0.8), (0.8, 0.6))])
@pytest.mark.parametrize("factor", [1, 2])
def test_points_and_scales_of_an_isothermal_lens(factor, axes):
    rays, n = isothermal(factor, axes)
    radius, angle = np.array([0.5, 0.7, 1.4, 1.7]), np.array([0.1, 1.0, 2.2, -0.8])
    positions = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    points = nested_points(WIDE, rays, n, PAPER, positions)
    expected = positions * (1.0 - 1.0 / radius)[:, None]
    np.testing.assert_allclose(points[:, :2], expected, atol=2e-3)
    mu = 1.0 / np.abs(1.0 - 1.0 / radius)
    np.testing.assert_allclose(points[:, 2], 0.1 / np.sqrt(mu), rtol=0.03)


def test_scale_on_a_critical_curve_is_finite_and_does_not_depend_on_the_mesh():
    """mean |1 - 1/r| over the disc around r = 1 is close to that of |x|, 4 r_trunc / (3 pi)."""
    scales = []
    for pixel_scale in (0.05, 0.02, 0.01):
        rays, n = isothermal(1, pixel_scale=pixel_scale)
        angles = np.linspace(0.0, 2.0, 20)
        points = nested_points(WIDE, rays, n, PAPER, np.stack([np.cos(angles), np.sin(angles)], axis=1))
        scales.append(points[:, 2].mean())
    np.testing.assert_allclose(scales, 0.1 * np.sqrt(4.0 * 0.1 / (3.0 * np.pi)), rtol=0.08)


def test_scale_is_clipped_and_positions_off_the_image_have_one():
    rays, n = isothermal()
    positions = np.array([[1.0, 0.0], [0.05, 0.0], [2.15, 0.0], [-2.3, 2.3]])
    points = nested_points(NestedShapelets(5, 1e-5, (0.05, 0.07)), rays, n, PAPER, positions)
    assert np.all((points[:, 2] >= 0.05) & (points[:, 2] <= 0.07))
    np.testing.assert_allclose(points[2, :2], (1.15, 0.0), atol=5e-3)
    assert np.isfinite(points).all()


@pytest.mark.parametrize("factor", [1, 2])
def test_columns_hold_all_images_and_leave_out_nothing(factor):
    rays, _ = isothermal(factor)
    point = np.array([0.1, 0.03, 0.04])
    pixels, columns = nested_columns(nested_basis(5, rays, PAPER), point)
    whole = pixel_basis((ShapeletSet(5, 0.04, 0.1, 0.03),), rays.source_x, rays.source_y)
    dense = np.zeros_like(whole)
    dense[pixels] = columns.T
    assert np.abs(dense - whole).max() < 1e-8 * np.abs(whole).max()
    assert pixels.size < 0.7 * whole.shape[0]
    for side in (1.0, -1.0):  # both images of the lens
        assert (side * rays.theta_x[pixels, 0] > 0.5).any()


def test_columns_of_several_points_side_by_side():
    rays, n = isothermal()
    points = np.array([[0.1, 0.03, 0.04], [0.12, 0.03, 0.06], [-1.0, 0.5, 0.02]])
    nested = nested_basis(2, rays, PAPER)
    seen, block = nested_block(nested, points)
    together = np.zeros((n * n, 18))
    together[seen] = block.T
    expected = np.zeros_like(together)
    for i, point in enumerate(points):
        pixels, columns = nested_columns(nested, point)
        expected[pixels, 6 * i : 6 * i + 6] = columns.T
    np.testing.assert_array_equal(together, expected)
    assert np.array_equal(seen, np.flatnonzero(together.any(axis=1)))
    assert nested_block(nested_basis(-1, rays, PAPER), points)[1].size == 0


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ((-1, 1e-5, (0.02, 0.1)), r"scan\.nested\.n_max"),
        ((5, 0.0, (0.02, 0.1)), r"scan\.nested\.ridge"),
        ((5, 1e-5, (0.1, 0.02)), r"scan\.nested\.beta_range"),
        ((5, 1e-5, (0.0, 0.1)), r"scan\.nested\.beta_range"),
    ],
)
def test_impossible_settings_are_refused(arguments, reason):
    with pytest.raises(ValueError, match=reason):
        NestedShapelets(*arguments)
