from __future__ import annotations

import numpy as np
import pytest

from warmlens.imaging.grid import PixelGrid

ROTATED = PixelGrid(5, 7, 0.05, -0.3, 0.2, ((0.6, -0.8), (0.8, 0.6)))


def test_pixels_and_sky_are_inverse() -> None:
    rng = np.random.default_rng(1)
    columns, rows = rng.uniform(0, 7, 20), rng.uniform(0, 5, 20)
    for grid in (ROTATED, PixelGrid.centred((5, 7), 0.1, 1.0, 2.0)):
        back = grid.to_pixel(*grid.to_sky(columns, rows))
        np.testing.assert_allclose(back, [columns, rows], atol=1e-12)


def test_centred() -> None:
    x, y = PixelGrid.centred((4, 6), 0.05, 1.0, -2.0).coordinates()
    assert x.mean() == pytest.approx(1.0)
    assert y.mean() == pytest.approx(-2.0)
    np.testing.assert_allclose(np.diff(x, axis=1), 0.05)
    np.testing.assert_allclose(np.diff(y, axis=0), 0.05)


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_subpixels_average_to_the_pixel(factor: int) -> None:
    x, y = ROTATED.coordinates()
    sub_x, sub_y = ROTATED.subpixel_coordinates(factor)
    assert sub_x.shape == (35, factor**2)
    np.testing.assert_allclose(sub_x.mean(axis=1), x.ravel(), atol=1e-14)
    np.testing.assert_allclose(sub_y.mean(axis=1), y.ravel(), atol=1e-14)
    assert len(np.unique(np.round(sub_x + 1e3 * sub_y, 9))) == 35 * factor**2


def test_padding_keeps_the_pixels() -> None:
    inner = ROTATED.coordinates()
    outer = ROTATED.padded(3).coordinates()
    for a, b in zip(inner, outer, strict=True):
        np.testing.assert_allclose(b[3:-3, 3:-3], a, atol=1e-14)


def test_factor_zero() -> None:
    with pytest.raises(ValueError, match="must be >= 1, got 0"):
        ROTATED.subpixel_coordinates(0)
