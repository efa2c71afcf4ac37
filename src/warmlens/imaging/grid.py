"""Pixel grid of an image: where on the sky each pixel and sub-pixel lies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warmlens.types import FloatArray


@dataclass(frozen=True)
class PixelGrid:
    """Square pixels on the tangent plane, in the N-up frame (x to the West, y to the North).

    Attributes
    ----------
    ny, nx
        Image shape [y, x].
    pixel_scale
        Side of a pixel [arcsec].
    origin_x, origin_y
        Sky position of the centre of pixel [0, 0] [arcsec].
    axes
        ((xx, xy), (yx, yy)): the sky direction (x, y) of one step along image columns is (xx, yx), of
        one step along image rows (xy, yy); orthonormal. The identity for an image with north up.
    """

    ny: int
    nx: int
    pixel_scale: float
    origin_x: float
    origin_y: float
    axes: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 0.0), (0.0, 1.0))

    @classmethod
    def centred(cls, shape: tuple[int, int], pixel_scale: float, x: float = 0.0, y: float = 0.0) -> PixelGrid:
        """Return the grid with north up whose geometric centre lies at (x, y) [arcsec]."""
        ny, nx = shape
        return cls(ny, nx, pixel_scale, x - 0.5 * (nx - 1) * pixel_scale, y - 0.5 * (ny - 1) * pixel_scale)

    @property
    def shape(self) -> tuple[int, int]:
        """Image shape (ny, nx)."""
        return self.ny, self.nx

    def to_sky(self, columns: FloatArray, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the sky position (x, y) [arcsec] of (fractional, 0-based) pixel columns and rows."""
        (xx, xy), (yx, yy) = self.axes
        x = self.origin_x + self.pixel_scale * (xx * columns + xy * rows)
        y = self.origin_y + self.pixel_scale * (yx * columns + yy * rows)
        return x, y

    def to_pixel(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the fractional, 0-based (column, row) of sky positions [arcsec]; the inverse of `to_sky`."""
        (xx, xy), (yx, yy) = self.axes
        dx = (np.asarray(x) - self.origin_x) / self.pixel_scale
        dy = (np.asarray(y) - self.origin_y) / self.pixel_scale
        return xx * dx + yx * dy, xy * dx + yy * dy

    def coordinates(self) -> tuple[FloatArray, FloatArray]:
        """Return the sky positions (x, y) of the pixel centres, each [ny, nx] [arcsec]."""
        rows, columns = np.mgrid[: self.ny, : self.nx].astype(np.float64)
        return self.to_sky(columns, rows)

    def subpixel_coordinates(self, factor: int) -> tuple[FloatArray, FloatArray]:
        """Return sky positions (x, y) of factor x factor sub-pixel centres, each [ny * nx, factor**2] [arcsec].

        Row p belongs to pixel p = row * nx + column; the mean over the second axis is the pixel.
        """
        if factor < 1:
            raise ValueError(f"supersampling factor must be >= 1, got {factor}")
        offset = (np.arange(factor) + 0.5) / factor - 0.5
        rows, columns = np.mgrid[: self.ny, : self.nx].astype(np.float64)
        sub_rows = rows[:, :, None, None] + offset[None, None, :, None]
        sub_columns = columns[:, :, None, None] + offset[None, None, None, :]
        sub_rows, sub_columns = np.broadcast_arrays(sub_rows, sub_columns)
        n = self.ny * self.nx
        return self.to_sky(sub_columns.reshape(n, factor**2), sub_rows.reshape(n, factor**2))

    def padded(self, margin: int) -> PixelGrid:
        """Return the same grid with `margin` more pixels on every side."""
        x, y = self.to_sky(np.array(-float(margin)), np.array(-float(margin)))
        return PixelGrid(
            self.ny + 2 * margin, self.nx + 2 * margin, self.pixel_scale, float(x), float(y), self.axes
        )
