from __future__ import annotations

import numpy as np

from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.mock import lensed_image, subpixel_field
from warmlens.imaging.psf import Convolution
from warmlens.imaging.shapelets import ShapeletSet, pixel_basis


def test_subpixel_field_is_exact_for_one_and_accurate_for_smooth_fields() -> None:
    grid = PixelGrid.centred((40, 50), 0.05)
    x, y = grid.coordinates()
    field = np.array([np.sin(2 * x) * np.cos(3 * y), x * y])
    assert np.array_equal(subpixel_field(field, 1)[..., 0], field.reshape(2, -1))
    sub_x, sub_y = grid.subpixel_coordinates(3)
    expected = np.array([np.sin(2 * sub_x) * np.cos(3 * sub_y), sub_x * sub_y])
    error = np.abs(subpixel_field(field, 3) - expected).reshape(2, 40, 50, 9)[:, 8:-8, 8:-8]
    assert error.max() < 1e-5


def test_lensed_image_is_the_blurred_basis() -> None:
    rng = np.random.default_rng(4)
    sets = (ShapeletSet(5, 0.2, 0.1, 0.0), ShapeletSet(2, 0.05, -0.1, 0.2))
    grid = PixelGrid.centred((20, 22), 0.05)
    x, y = grid.subpixel_coordinates(2)
    psf = rng.random((5, 5))
    convolution = Convolution(psf / psf.sum(), grid.shape)
    coefficients = rng.normal(size=sum(shapelets.n_coefficients for shapelets in sets))
    expected = convolution.forward((pixel_basis(sets, x, y) @ coefficients).reshape(grid.shape))
    np.testing.assert_allclose(lensed_image(sets, coefficients, x, y, convolution), expected, atol=1e-12)
