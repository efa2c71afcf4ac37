"""Noise of the observation and of its mocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warmlens.imaging.noise_correlation import correlate
from warmlens.types import FloatArray


@dataclass(frozen=True)
class NoiseModel:
    """Gaussian background and Poisson noise of the exposure, of independent pixels or of correlated ones.

    Attributes
    ----------
    background_rms
        Of a pixel [e-/s]; None if the user gave a noise map.
    exposure_s
        Exposure time [s]; None if the user gave a noise map: then a mock's noise is Gaussian with that map.
    correlation
        Correlation function of the noise between pixels (`imaging.noise_correlation`); None: they are independent.
    """

    background_rms: float | None
    exposure_s: float | None
    correlation: FloatArray | None = None

    def sigma(self, image: FloatArray) -> FloatArray:
        """Noise estimated from the image d: sigma^2 = background^2 + max(d, 0) / exposure."""
        if self.background_rms is None or self.exposure_s is None:
            raise ValueError("a noise map was given: it is not estimated from the image")
        return np.sqrt(self.background_rms**2 + np.maximum(image, 0.0) / self.exposure_s)

    def draw(self, image: FloatArray, sigma: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Noisy version of a noiseless image [ny, nx] [e-/s]; `sigma` is used where only a noise map is known.

        Correlated noise has the same variance in every pixel as independent noise: that is divided by its sigma,
        filtered, and multiplied again.
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
