"""Perturber, rays, raster."""

import numpy as np
import pytest

from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.perturber import Perturber, moved_pixels
from warmlens.scan.raster import Raster

PAPER = Perturber(0.01, 0.1)


def test_deflection_is_the_paper_s():
    """Birrer+2017 sec. 4.1: constant inside r_trunc, linear to zero at 2 r_trunc."""
    radius = np.array([1e-9, 0.05, 0.1, 0.125, 0.15, 0.19, 0.2, 0.3])
    expected = np.array([0.01, 0.01, 0.01, 0.0075, 0.005, 0.001, 0.0, 0.0])
    for angle in (0.3, 2.0, -1.2):
        x, y = PAPER.deflection(radius * np.cos(angle), radius * np.sin(angle))
        np.testing.assert_allclose(x, expected * np.cos(angle), atol=1e-15)
        np.testing.assert_allclose(y, expected * np.sin(angle), atol=1e-15)


def test_deflection_at_the_centre_and_on_grids():
    x, y = PAPER.deflection(np.zeros((2, 3)), 0.0)
    assert x.shape == y.shape == (2, 3)
    np.testing.assert_array_equal(x, 0.0)


def test_deflection_focusses_with_the_mass_of_the_paper():
    """Mean convergence inside r_trunc is theta_E / r_trunc, from the divergence of the deflection."""
    axis = (np.arange(401) - 200) * 0.0005
    x, y = np.meshgrid(axis, axis)
    step = 1e-6
    divergence = (PAPER.deflection(x + step, y)[0] - PAPER.deflection(x - step, y)[0]) / (2.0 * step) + (
        PAPER.deflection(x, y + step)[1] - PAPER.deflection(x, y - step)[1]
    ) / (2.0 * step)
    ring = (np.hypot(x, y) > 0.02) & (np.hypot(x, y) < 0.1)
    enclosed = np.sum(0.5 * divergence[ring]) * 0.0005**2
    assert enclosed == pytest.approx(np.pi * 0.01 * (0.1 - 0.02), rel=0.01)


@pytest.mark.parametrize("parameters", [(0.0, 0.1), (0.01, -0.1), (np.nan, 0.1)])
def test_impossible_perturbers_are_refused(parameters):
    with pytest.raises(ValueError, match="perturber"):
        Perturber(*parameters)


def test_raster_of_the_paper():
    raster = Raster(4.0, 4.0, 0.05, (0.1, -0.2))
    assert raster.shape == (80, 80)
    assert raster.n_positions == 6400
    xy = raster.coordinates().reshape(80, 80, 2)
    np.testing.assert_allclose(np.diff(xy[..., 0], axis=1), 0.05, rtol=1e-9)
    np.testing.assert_allclose(np.diff(xy[..., 1], axis=0), 0.05, rtol=1e-9)
    np.testing.assert_allclose(xy.mean(axis=(0, 1)), (0.1, -0.2), atol=1e-12)
    np.testing.assert_allclose(xy[0, 0], (0.1 - 1.975, -0.2 - 1.975), atol=1e-12)


def test_raster_rounds_its_extent():
    """4 / 0.05 is not an integer in floating point; 0.3 / 0.1 is 2.999..."""
    assert Raster(0.3, 0.1, 0.1).shape == (1, 3)
    with pytest.raises(ValueError, match="no position"):
        Raster(0.01, 1.0, 0.05)
    with pytest.raises(ValueError, match="step"):
        Raster(1.0, 1.0, 0.0)


def test_rays_are_checked():
    x = np.zeros((4, 1))
    with pytest.raises(ValueError, match="one shape"):
        SmoothRays(x, x, x, np.zeros((4, 2)))
    with pytest.raises(ValueError, match="source_y"):
        SmoothRays(x, x, x, np.full((4, 1), np.nan))


@pytest.mark.parametrize("factor", [1, 3])
def test_moved_pixels_are_those_with_a_deflected_sub_pixel(factor):
    grid = PixelGrid.centred((20, 16), 0.05)
    x, y = grid.subpixel_coordinates(factor)
    positions = np.array([[0.0, 0.0], [0.013, -0.21], [0.39, 0.49], [0.56, 0.0], [0.7, 0.0], [0.1, 0.1]])
    unmasked = np.ones(320, dtype=bool)
    offsets, pixels = moved_pixels(x, y, unmasked, positions, PAPER.reach)
    for i, (center_x, center_y) in enumerate(positions):
        alpha = np.hypot(*PAPER.deflection(x - center_x, y - center_y))
        expected = np.flatnonzero((alpha > 1e-12).any(axis=1))
        np.testing.assert_array_equal(pixels[offsets[i] : offsets[i + 1]], expected)
    counts = np.diff(offsets)
    assert counts[0] > 40
    assert 0 < counts[3] < counts[2] < counts[0]
    assert counts[4] == 0


def test_masked_neighbourhood_moves_nothing():
    grid = PixelGrid.centred((20, 20), 0.05)
    x, y = grid.subpixel_coordinates(1)
    unmasked = (x < 0.0).ravel()
    positions = np.array([[0.3, 0.0], [0.05, 0.0]])
    offsets, pixels = moved_pixels(x, y, unmasked, positions, PAPER.reach)
    assert offsets[1] == 0
    assert unmasked[pixels].any()
    assert not unmasked[pixels].all()  # masked pixels shine on unmasked ones: they belong to the change


def test_inside_the_truncation_it_is_lenstronomys_isothermal_sphere():
    from lenstronomy.LensModel.Profiles.sis import SIS

    rng = np.random.default_rng(3)
    radius, angle = 0.1 * np.sqrt(rng.random(50)), 2.0 * np.pi * rng.random(50)
    dx, dy = radius * np.cos(angle), radius * np.sin(angle)
    np.testing.assert_allclose(Perturber(0.01, 0.1).deflection(dx, dy), SIS().derivatives(dx, dy, 0.01), atol=1e-9)
