from __future__ import annotations

import numpy as np
import pytest

from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.deflection import TnfwHalos, tnfw_deflection
from warmlens.lensing.pixel_mean import narrower_than_pixel, pixel_deflection

COS, SIN = np.cos(0.4), np.sin(0.4)
GRID = PixelGrid(50, 40, 0.05, -1.0, -0.5, ((COS, -SIN), (SIN, COS)))


def _one(column: float, row: float, r_s: float, r_t: float) -> TnfwHalos:
    x, y = GRID.to_sky(np.array([column]), np.array([row]))
    return TnfwHalos(x, y, np.array([r_s]), np.array([r_t]), np.array([1e-3]))


def _mean(halo: TnfwHalos, n: int = 25) -> np.ndarray:
    return tnfw_deflection(*GRID.subpixel_coordinates(n), halo).mean(axis=-1).reshape(2, *GRID.shape)


@pytest.mark.parametrize(("r_s", "r_t"), [(0.02, 0.1), (0.04, 1.0), (0.3, 0.04)])
@pytest.mark.parametrize("place", [(20.0, 25.0), (20.4, 25.2), (0.3, 24.6)])
def test_narrow_halos_are_averaged(place: tuple[float, float], r_s: float, r_t: float) -> None:
    halo = _one(*place, r_s, r_t)
    mean, centre = _mean(halo), tnfw_deflection(*GRID.coordinates(), halo)
    peak = np.abs(mean).max()
    assert np.abs(pixel_deflection(GRID, halo) - mean).max() < 0.015 * peak
    if place != (20.0, 25.0):  # a halo on a pixel's centre deflects that pixel by 0 either way
        assert np.abs(centre - mean).max() > 0.05 * peak  # what it would be without


def test_wide_halos_are_not() -> None:
    halo = _one(20.4, 25.2, 0.06, 0.3)
    assert np.array_equal(pixel_deflection(GRID, halo), tnfw_deflection(*GRID.coordinates(), halo))


def test_each_halo_for_itself() -> None:
    narrow, wide = _one(12.3, 30.1, 0.02, 0.2), _one(25.0, 12.2, 0.2, 0.5)
    both = TnfwHalos(*(np.concatenate(pair) for pair in zip(narrow, wide, strict=True)))
    assert narrower_than_pixel(GRID, both).tolist() == [True, False]
    expected = pixel_deflection(GRID, narrow) + tnfw_deflection(*GRID.coordinates(), wide)
    np.testing.assert_allclose(pixel_deflection(GRID, both), expected, atol=1e-15)


def test_a_halo_off_the_image_changes_nothing_near() -> None:
    halo = _one(-30.0, 90.0, 0.02, 0.2)
    assert np.array_equal(pixel_deflection(GRID, halo), tnfw_deflection(*GRID.coordinates(), halo))
