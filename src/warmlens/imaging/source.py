"""The clumpy face-on spiral that lies behind the simulated lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warmlens.types import FloatArray

_CORE = 0.3  # core of the disc in units of its scale: rounds off the cusp of the exponential
_ARMS, _PITCH = 2, 0.45  # number of spiral arms; d ln r / d phi along an arm


@dataclass(frozen=True)
class SpiralSource:
    """An exponential disc and Gaussian clumps along two logarithmic spiral arms.

    Attributes
    ----------
    center_x, center_y, disc_scale
        Centre and scale length of the disc [arcsec].
    clump_x, clump_y, clump_sigma, clump_weight
        Position and width [arcsec] and share of the clumps' flux of each clump, [n]; weights sum to 1.
    """

    center_x: float
    center_y: float
    disc_scale: float
    clump_x: FloatArray
    clump_y: FloatArray
    clump_sigma: FloatArray
    clump_weight: FloatArray

    @classmethod
    def draw(
        cls,
        center: tuple[float, float],
        disc_scale: float,
        n_clumps: int,
        clump_sigma: tuple[float, float],
        rng: np.random.Generator,
    ) -> SpiralSource:
        """Scatter clumps about two arms between 0.5 and 3.5 disc scales, fluxes log-normal (0.35 dex)."""
        radius = disc_scale * rng.uniform(0.5, 3.5, n_clumps)
        arm = rng.integers(_ARMS, size=n_clumps)
        phi = np.log(radius / disc_scale) / _PITCH + 2 * np.pi * arm / _ARMS + 0.15 * rng.standard_normal(n_clumps)
        weight = 10 ** (0.35 * rng.standard_normal(n_clumps)) * np.exp(-0.5 * radius / disc_scale)
        return cls(
            *center,
            disc_scale,
            center[0] + radius * np.cos(phi),
            center[1] + radius * np.sin(phi),
            rng.uniform(*clump_sigma, n_clumps),
            weight / weight.sum() if n_clumps else weight,
        )

    def surface_brightness(self, x: FloatArray, y: FloatArray, flux: float, clump_fraction: float) -> FloatArray:
        """Return the surface brightness [flux per square arcsec] at source positions [arcsec], of any shape."""
        core = _CORE * self.disc_scale
        r = np.hypot(x - self.center_x, y - self.center_y)
        disc = np.exp(-(np.sqrt(r**2 + core**2) - core) / self.disc_scale)
        # integral of the cored exponential over the plane: 2 pi h (h + core)
        disc_flux = 2 * np.pi * self.disc_scale * (self.disc_scale + core)
        total = (1.0 - clump_fraction) * disc / disc_flux
        for cx, cy, s, w in zip(self.clump_x, self.clump_y, self.clump_sigma, self.clump_weight, strict=True):
            r2 = (x - cx) ** 2 + (y - cy) ** 2
            total += clump_fraction * w / (2 * np.pi * s**2) * np.exp(-0.5 * r2 / s**2)
        return flux * total
