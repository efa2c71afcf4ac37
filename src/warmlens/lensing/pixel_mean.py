"""Deflection of halos as the pixels of an image see it.

One ray per pixel carries the light of the pixel, so a pixel needs its mean deflection: to first order in the
gradient of the source that gives its mean brightness. Where the deflection is smooth over a pixel, the value at
the centre is the mean. About a halo narrower than a pixel it is not, and there the mean is taken over sub-pixels.
Away from the halo both agree again: the deflection is harmonic there, and the mean of a harmonic function is its
value at the centre. A few pixels about each such halo are therefore enough.
"""

from __future__ import annotations

import numpy as np

from warmlens.imaging.grid import PixelGrid
from warmlens.kernels import njit
from warmlens.lensing.deflection import (
    SEGMENT_SHIFT,
    X_FLOOR,
    TnfwHalos,
    radial_table,
    read_table,
    tnfw_deflection,
)
from warmlens.types import BoolArray, FloatArray

SUB_PIXELS = 7  # along a side of a pixel: the mean is within 1% of the halo's largest deflection
REACH_PIXELS = 6  # on every side of the pixel that holds the halo


def pixel_deflection(grid: PixelGrid, halos: TnfwHalos) -> FloatArray:
    """Return the summed deflection (alpha_x, alpha_y) of all halos at each pixel, [2, ny, nx] [arcsec].

    It is the value at the pixel centre. Up to `REACH_PIXELS` from halos `narrower_than_pixel` it is their mean
    over `SUB_PIXELS`**2 sub-pixels.
    """
    alpha = tnfw_deflection(*grid.coordinates(), halos)
    narrow = narrower_than_pixel(grid, halos)
    if not narrow.any():
        return alpha
    x, y, r_s, r_t, scale = (array[narrow] for array in halos)
    columns, rows = grid.to_pixel(x, y)
    along_columns, along_rows = _mean_minus_centre(grid.shape, grid.pixel_scale, columns, rows, r_s, r_t, scale)
    (xx, xy), (yx, yy) = grid.axes
    alpha[0] += xx * along_columns + xy * along_rows
    alpha[1] += yx * along_columns + yy * along_rows
    return alpha


def narrower_than_pixel(grid: PixelGrid, halos: TnfwHalos) -> BoolArray:
    """Return which halos have a scale or a truncation radius below the side of a pixel, [n]."""
    return np.minimum(halos.r_s_arcsec, halos.r_t_arcsec) < grid.pixel_scale


@njit(cache=True, error_model="numpy")
def _mean_minus_centre(
    shape: tuple[int, int],
    pixel_scale: float,
    column: FloatArray,
    row: FloatArray,
    r_s: FloatArray,
    r_t: FloatArray,
    alpha_scale: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the mean over each pixel less the value at its centre [ny, nx], summed over halos.

    Halos lie at fractional pixels (column, row). The components are along the columns and the rows of the image
    [arcsec].
    """
    ny, nx = shape
    along_columns = np.zeros((ny, nx))
    along_rows = np.zeros((ny, nx))
    offset = (np.arange(SUB_PIXELS) + 0.5) / SUB_PIXELS - 0.5
    weight = 1.0 / SUB_PIXELS**2
    for k in range(column.size):
        low_row, low_column = int(np.rint(row[k])) - REACH_PIXELS, int(np.rint(column[k])) - REACH_PIXELS
        high_row, high_column = low_row + 2 * REACH_PIXELS + 1, low_column + 2 * REACH_PIXELS + 1
        unit = (pixel_scale / r_s[k]) ** 2
        tau = r_t[k] / r_s[k]
        s_floor = (X_FLOOR * min(1.0, tau)) ** 2
        first = np.float64(s_floor).view(np.int64) >> SEGMENT_SHIFT
        far = max(s_floor, 2.0 * (REACH_PIXELS + 1.0) ** 2 * unit)
        flat = (alpha_scale[k] / r_s[k] * pixel_scale * radial_table(s_floor, far, tau)).ravel()
        for i in range(max(low_row, 0), min(high_row, ny)):
            for j in range(max(low_column, 0), min(high_column, nx)):
                dx, dy = j - column[k], i - row[k]
                h = read_table(flat, first, max(s_floor, (dx * dx + dy * dy) * unit))
                mean_x, mean_y = -h * dx, -h * dy
                for a in range(SUB_PIXELS):
                    for b in range(SUB_PIXELS):
                        sub_x, sub_y = dx + offset[a], dy + offset[b]
                        h = weight * read_table(flat, first, max(s_floor, (sub_x * sub_x + sub_y * sub_y) * unit))
                        mean_x += h * sub_x
                        mean_y += h * sub_y
                along_columns[i, j] += mean_x
                along_rows[i, j] += mean_y
    return along_columns, along_rows
