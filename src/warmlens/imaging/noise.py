"""Noise of the observation and of its mocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warmlens.imaging.noise_correlation import correlate
from warmlens.types import FloatArray


@dataclass(frozen=True)
class NoiseModel:
    """Gaussian background and Poisson noise of the exposure, of independent or of correlated pixels.

    Attributes
    ----------
    background_rms, exposure_s
        Background noise of a pixel [e-/s] and exposure time [s]. Both are None if the user gave a noise map; then
        the noise of a mock is Gaussian with that map.
    correlation
        Correlation function of the noise between pixels (`imaging.noise_correlation`); None: they are independent.
    """

    background_rms: float | None
    exposure_s: float | None
    correlation: FloatArray | None = None

    def sigma(self, image: FloatArray) -> FloatArray:
        """Return the noise estimated from the image d: sigma^2 = background^2 + max(d, 0) / exposure."""
        if self.background_rms is None or self.exposure_s is None:
            raise ValueError("a noise map was given: it is not estimated from the image")
        return np.sqrt(self.background_rms**2 + np.maximum(image, 0.0) / self.exposure_s)

    def draw(self, image: FloatArray, sigma: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Add noise to a noiseless image [ny, nx] [e-/s]; `sigma` is used only if the user gave a noise map.

        Correlated noise has the same variance in every pixel as independent noise: independent noise is divided by
        its sigma, filtered, and multiplied by sigma again.
        """
        if self.background_rms is None or self.exposure_s is None:
            scale = np.where(np.isfinite(sigma), sigma, 0.0)
            white = rng.standard_normal(image.shape)
            if self.correlation is None:
                return image + scale * white
        else:
            counts = rng.poisson(np.maximum(image, 0.0) * self.exposure_s)
            background = self.background_rms * rng.standard_normal(image.shape)
            noisy = np.minimum(image, 0.0) + counts / self.exposure_s + background
            if self.correlation is None:
                return noisy
            scale = self.sigma(image)
            white = (noisy - image) / scale
        return image + scale * correlate(white, self.correlation)
