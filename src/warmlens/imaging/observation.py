"""The observed image in one or several bands, checked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.psf import validate_psf
from warmlens.types import BoolArray, FloatArray


@dataclass(frozen=True)
class Band:
    """One band, arrays [ny, nx]."""

    name: str
    image: FloatArray  # [e-/s per pixel]
    sigma: FloatArray  # noise [e-/s per pixel]
    mask: BoolArray  # true on pixels that are used
    psf: FloatArray  # on the image pixels, odd sides, sum 1
    noise: NoiseModel  # of mocks

    @property
    def weights(self) -> FloatArray:
        """1 / sigma, 0 on masked pixels."""
        return np.where(self.mask, 1.0 / np.where(self.mask, self.sigma, 1.0), 0.0)


@dataclass(frozen=True)
class Observation:
    """All bands on one pixel grid."""

    kind: Literal["simulated", "fits"]
    grid: PixelGrid
    bands: tuple[Band, ...]


def checked_band(
    name: str,
    grid: PixelGrid,
    image: FloatArray,
    sigma: FloatArray,
    mask: BoolArray,
    psf: FloatArray,
    noise: NoiseModel,
) -> Band:
    """Build a `Band` after checking shapes, finite pixels, positive noise and the PSF.

    Raises
    ------
    ValueError
        With the band, what is wrong, where, and what to do.
    """
    for label, array in (("image", image), ("sigma", sigma), ("mask", mask)):
        if array.shape != grid.shape:
            raise ValueError(
                f"band {name}: the {label} has shape {array.shape}, the science image {grid.shape}; "
                "cut both to the same pixels"
            )
    if not mask.any():
        raise ValueError(f"band {name}: the mask leaves no pixel; 1 marks pixels that are used")
    bad = mask & ~np.isfinite(image)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise ValueError(
            f"band {name}: {bad.sum()} unmasked pixels of the image are not finite, the first at "
            f"[y, x] = [{row}, {column}]; mask them (0 in the mask)"
        )
    bad = mask & ~(np.isfinite(sigma) & (sigma > 0))
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise ValueError(
            f"band {name}: the noise of {bad.sum()} unmasked pixels is not positive, the first at "
            f"[y, x] = [{row}, {column}]; mask them or mend the sigma or weight map"
        )
    return Band(
        name=name,
        image=np.where(mask, image, 0.0),
        sigma=np.where(mask, sigma, np.inf),
        mask=mask,
        psf=validate_psf(psf, f"band {name}"),
        noise=noise,
    )
