"""High-pass filter that keeps only what substructure adds to the deflection on small scales."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from warmlens.types import FloatArray

TRUNCATE_SIGMA = 4.0


def margin_pixels(sigma_arcsec: float, pixel_scale: float) -> int:
    """Pixels to add on every side of a field so that its crop is free of edge effects.

    Parameters
    ----------
    sigma_arcsec
        Standard deviation of the Gaussian [arcsec].
    pixel_scale
        Side of a pixel [arcsec].

    Returns
    -------
    margin
        The radius of the kernel, which is cut at `TRUNCATE_SIGMA` standard deviations.
    """
    if not (0.0 < sigma_arcsec < np.inf and 0.0 < pixel_scale < np.inf):
        raise ValueError(
            f"sigma_arcsec and pixel_scale must be finite and > 0, got {sigma_arcsec!r} and {pixel_scale!r}"
        )
    return int(TRUNCATE_SIGMA * sigma_arcsec / pixel_scale + 0.5)


def high_pass(deflection: FloatArray, sigma_arcsec: float, pixel_scale: float) -> FloatArray:
    """Deflection minus its Gaussian-smoothed self.

    Parameters
    ----------
    deflection
        Deflection [arcsec], [..., ny, nx]; usually [2, ny, nx] as (x, y).
    sigma_arcsec
        Standard deviation of the Gaussian [arcsec]; the paper's phi_min = 0.4".
    pixel_scale
        Side of a pixel [arcsec].

    Returns
    -------
    filtered
        The shape of `deflection` [arcsec]. Within `margin_pixels` of the edge it depends on what lies beyond
        (there the last pixel is repeated): pass a padded field and `crop` it.

    Reference: Birrer+2017 sec. 3.2, Delta alpha_dm = alpha_dm - alpha_dm * g(phi_min).
    """
    radius = margin_pixels(sigma_arcsec, pixel_scale)
    if not np.isfinite(deflection).all():
        raise ValueError("deflection must be finite")
    smoothed = gaussian_filter(
        deflection, sigma_arcsec / pixel_scale, axes=(-2, -1), mode="nearest", radius=radius
    )
    return deflection - smoothed


def crop(field: FloatArray, margin: int) -> FloatArray:
    """The field [..., ny, nx] without `margin` pixels on every side; undoes `PixelGrid.padded`."""
    ny, nx = field.shape[-2:]
    if margin < 0 or 2 * margin >= min(ny, nx):
        raise ValueError(f"margin must be >= 0 and leave a pixel of the {ny} x {nx} field, got {margin}")
    return field[..., margin : ny - margin, margin : nx - margin]
