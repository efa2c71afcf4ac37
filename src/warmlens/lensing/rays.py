"""Rays of an image through the smooth lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warmlens.types import FloatArray


@dataclass(frozen=True)
class SmoothRays:
    """Rays of all sub-pixels through the smooth lens model, each [npix, s2] [arcsec].

    They go from theta on the sky (`PixelGrid.subpixel_coordinates`) to theta - alpha_smooth(theta) in the source
    plane.
    """

    theta_x: FloatArray
    theta_y: FloatArray
    source_x: FloatArray
    source_y: FloatArray

    def __post_init__(self) -> None:
        shapes = {array.shape for array in (self.theta_x, self.theta_y, self.source_x, self.source_y)}
        if len(shapes) != 1 or self.theta_x.ndim != 2:
            raise ValueError(f"rays must be four arrays of one shape [npix, s2], got {sorted(shapes)}")
        for name in ("theta_x", "theta_y", "source_x", "source_y"):
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if not np.all(np.isfinite(array)):
                raise ValueError(f"{name} of the smooth rays is not finite everywhere; check the lens model")
            object.__setattr__(self, name, array)
