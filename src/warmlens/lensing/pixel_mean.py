"""Deflection of subhalos as the pixels of an image see it.

One ray a pixel carries the pixel's light, so what is wanted of a pixel is its mean deflection: to first order
in the source's gradient that gives the pixel's mean brightness. The value at the centre is that mean wherever
the deflection is smooth over a pixel; about a halo narrower than a pixel it is not, and there the mean is taken
over sub-pixels. Away from the halo both agree again (outside of it the deflection is harmonic, and the mean of a
harmonic function is its value at the centre), so that a few pixels about each such halo are enough.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.deflection import SEGMENT_SHIFT, X_FLOOR, radial_table, read_table, tnfw_deflection
from warmlens.types import BoolArray, FloatArray

SUB_PIXELS = 7  # along a side of a pixel: the mean is within 1% of the halo's largest deflection
REACH_PIXELS = 6  # on every side of the pixel that holds the halo


def pixel_deflection(
    grid: PixelGrid,
    center_x: FloatArray,
    center_y: FloatArray,
    r_s_arcsec: FloatArray,
    r_t_arcsec: FloatArray,
    alpha_scale: FloatArray,
) -> FloatArray:
    """Sum of the deflections of all subhalos at each pixel.

    Parameters
    ----------
    grid
        Pixels.
    center_x, center_y, r_s_arcsec, r_t_arcsec, alpha_scale
        Subhalos, each [n], as in `tnfw_deflection`.

    Returns
    -------
    deflection
        (alpha_x, alpha_y) [arcsec], [2, ny, nx]: at the pixel centres, and for halos `narrower_than_pixel`
        the mean over `SUB_PIXELS`**2 sub-pixels, up to `REACH_PIXELS` from them.
    """
    subhalos = (center_x, center_y, r_s_arcsec, r_t_arcsec, alpha_scale)
    alpha = tnfw_deflection(*grid.coordinates(), *subhalos)
    narrow = narrower_than_pixel(grid, r_s_arcsec, r_t_arcsec)
    if not narrow.any():
        return alpha
    x, y, r_s, r_t, scale = (np.ascontiguousarray(value, dtype=np.float64)[narrow] for value in subhalos)
    columns, rows = grid.to_pixel(x, y)
    along_columns, along_rows = _mean_minus_centre(
        grid.ny, grid.nx, grid.pixel_scale, columns, rows, r_s, r_t, scale
    )
    (xx, xy), (yx, yy) = grid.axes
    alpha[0] += xx * along_columns + xy * along_rows
    alpha[1] += yx * along_columns + yy * along_rows
    return alpha


def narrower_than_pixel(grid: PixelGrid, r_s_arcsec: FloatArray, r_t_arcsec: FloatArray) -> BoolArray:
    """Which halos have a scale or a truncation radius below the side of a pixel, [n]."""
    return np.minimum(r_s_arcsec, r_t_arcsec) < grid.pixel_scale


@njit(cache=True, error_model="numpy")
def _mean_minus_centre(
    ny: int,
    nx: int,
    pixel_scale: float,
    column: npt.NDArray[np.float64],
    row: npt.NDArray[np.float64],
    r_s: npt.NDArray[np.float64],
    r_t: npt.NDArray[np.float64],
    alpha_scale: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Mean over the pixel less the value at its centre [ny, nx], of halos at fractional pixels (column, row).

    Components along the columns and the rows of the image [arcsec].
    """
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
