"""Positions at which the substructure scan puts its perturber."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warmlens.imaging.grid import PixelGrid
from warmlens.types import BoolArray, FloatArray


@dataclass(frozen=True)
class Raster:
    """Positions of the scan: a regular grid, symmetric about its centre."""

    # Extent [arcsec]; round(width / step) x round(height / step) positions
    width: float
    height: float
    step: float  # distance of neighbours [arcsec]; 0.05 in the paper
    center: tuple[float, float] = (0.0, 0.0)  # sky position (x, y) of the centre [arcsec]

    @classmethod
    def around(cls, mask: BoolArray, grid: PixelGrid, step: float) -> Raster:
        """Cover the smallest upright box that holds all pixels of the mask [ny, nx]."""
        if mask.shape != grid.shape:
            raise ValueError(f"mask is {mask.shape}, the pixel grid {grid.shape}")
        if not mask.any():
            raise ValueError("no pixel is unmasked: nothing to scan; check the masks of the bands")
        rows, columns = np.argwhere(mask).T.astype(np.float64)
        corners = [(a, b) for a in (-0.5, 0.5) for b in (-0.5, 0.5)]
        x, y = np.array([grid.to_sky(columns + a, rows + b) for a, b in corners]).swapaxes(0, 1).reshape(2, -1)
        x, y = x.round(9), y.round(9)  # without the rounding errors that depend on the orientation of the detector
        center = (0.5 * float(x.min() + x.max()), 0.5 * float(y.min() + y.max()))
        return cls(float(np.ptp(x).round(9)), float(np.ptp(y).round(9)), step, center)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.step) and self.step > 0.0):
            raise ValueError(f"scan step must be a positive number of arcsec, got {self.step!r}")
        if not all(math.isfinite(value) for value in (self.width, self.height, *self.center)):
            raise ValueError("width, height and centre of the scan must be finite")
        if min(self.shape) < 1:
            raise ValueError(
                f"a scan of {self.width} x {self.height} arcsec holds no position at step {self.step} arcsec"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """Number of positions along (y, x)."""
        return round(self.height / self.step), round(self.width / self.step)

    @property
    def n_positions(self) -> int:
        """Number of positions."""
        return self.shape[0] * self.shape[1]

    def coordinates(self) -> FloatArray:
        """Return sky positions (x, y) [arcsec], [n_positions, 2], row-major in [y, x]: x runs fastest."""
        ny, nx = self.shape
        y = self.center[1] + self.step * (np.arange(ny) - 0.5 * (ny - 1))
        x = self.center[0] + self.step * (np.arange(nx) - 0.5 * (nx - 1))
        grid_y, grid_x = np.meshgrid(y, x, indexing="ij")
        return np.stack([grid_x.ravel(), grid_y.ravel()], axis=1)
