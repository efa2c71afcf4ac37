from __future__ import annotations

import numpy as np
import pytest

from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.high_pass import crop, high_pass, margin_pixels

SIGMA, PIXEL = 0.4, 0.05


@pytest.fixture
def coordinates():
    return PixelGrid.centred((128, 150), PIXEL).coordinates()


def test_constant_and_linear_fields_vanish_inside(coordinates):
    x, y = coordinates
    margin = margin_pixels(SIGMA, PIXEL)
    field = np.stack([3.0 + 0.2 * x - 0.1 * y, np.full(x.shape, -1.5)])
    filtered = high_pass(field, SIGMA, PIXEL)
    assert np.abs(crop(filtered, margin)).max() < 1e-12
    assert np.abs(filtered[0]).max() > 1e-2  # and the edge does not: the crop is needed


@pytest.mark.parametrize("wavelength", [0.5, 1.5, 3.0, 6.0])
def test_a_single_mode_is_damped_as_the_gaussian_says(coordinates, wavelength):
    x, y = coordinates
    k = 2 * np.pi / wavelength
    mode = np.cos(k * (0.6 * x + 0.8 * y))
    margin = margin_pixels(SIGMA, PIXEL)
    filtered = crop(high_pass(np.stack([mode, 2 * mode]), SIGMA, PIXEL), margin)
    expected = (1 - np.exp(-0.5 * (k * SIGMA) ** 2)) * crop(mode, margin)
    np.testing.assert_allclose(filtered, np.stack([expected, 2 * expected]), atol=4e-4)


def test_margin_is_just_enough():
    margin = margin_pixels(SIGMA, PIXEL)
    assert margin == 32
    rng = np.random.default_rng(2)
    field = rng.normal(size=(2, 100, 100))
    other = field.copy()
    other[:, 0, :] += 1.0  # a row at the very edge reaches `margin` rows and no further
    difference = np.abs(high_pass(other, SIGMA, PIXEL) - high_pass(field, SIGMA, PIXEL)).max(axis=(0, 2))
    assert (difference[margin + 1 :] == 0.0).all()
    assert difference[margin] > 0.0


def test_crop_undoes_padding():
    grid = PixelGrid.centred((8, 11), PIXEL)
    x, y = grid.padded(5).coordinates()
    np.testing.assert_allclose(crop(np.stack([x, y]), 5), np.stack(grid.coordinates()), atol=1e-12)
    assert crop(x, 0).shape == x.shape


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="sigma_arcsec"):
        margin_pixels(0.0, PIXEL)
    with pytest.raises(ValueError, match="finite"):
        high_pass(np.full((2, 4, 4), np.nan), SIGMA, PIXEL)
    with pytest.raises(ValueError, match="margin"):
        crop(np.zeros((4, 6)), 2)
