"""High-pass filters that keep only what substructure adds to the deflection on small scales.

Each subtracts a smoothed deflection. `gaussian` is the paper's; `starlet` and `median_wavelet` sum the finest
scales of a multiresolution transform, which is the field less its last smoothing. They smooth on discrete scales
only. To lowest order every smoothing adds sigma^2 / 2 times the Laplacian, with sigma^2 the variance of its
windows. The number of scales is therefore the one whose sigma is nearest in ratio to that of the Gaussian
(`effective_sigma_pixels`). For a median this holds where the field is level; on a slope only the curvature
across the slope counts, and the median subtracts less.

References: Birrer+2017 sec. 3.2 and its footnote; Starck, Fadili & Murtagh 2007 (starlet); Starck, Murtagh &
Bijaoui 1998 (multiresolution median transform).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
from scipy import ndimage

from warmlens.types import FloatArray

FilterKind = Literal["gaussian", "starlet", "median_wavelet"]

TRUNCATE_SIGMA = 4.0
_B3_SPLINE = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0  # of variance 1 pixel^2
_MAX_SCALES = 12
_MEDIAN_STARTS = (1, 2, 3)  # half-widths of the first median window; the next are twice as wide


def margin_pixels(sigma_arcsec: float, pixel_scale: float, kind: FilterKind = "gaussian") -> int:
    """Return the number of pixels to add on every side of a field so that its crop is free of edge effects.

    It is the reach of the filter: the radius of the Gaussian, which is cut at `TRUNCATE_SIGMA` standard
    deviations, or the sum of the half-widths of all windows. Parameters as in `high_pass`.
    """
    sigma = _in_pixels(sigma_arcsec, pixel_scale, kind)
    if kind == "gaussian":
        return int(TRUNCATE_SIGMA * sigma + 0.5)
    if kind == "starlet":
        return sum(2 * step for step in _starlet_steps(sigma))
    return sum(_median_half_widths(sigma))


def effective_sigma_pixels(sigma_arcsec: float, pixel_scale: float, kind: FilterKind) -> float:
    """Return the standard deviation [pixel] of the smoothing that filter `kind` subtracts for that Gaussian."""
    sigma = _in_pixels(sigma_arcsec, pixel_scale, kind)
    if kind == "gaussian":
        return sigma
    if kind == "starlet":
        return _starlet_sigma(_starlet_steps(sigma))
    return _median_sigma(_median_half_widths(sigma))


def high_pass(
    deflection: FloatArray, sigma_arcsec: float, pixel_scale: float, kind: FilterKind = "gaussian"
) -> FloatArray:
    """Subtract the smoothed deflection from the deflection.

    Parameters
    ----------
    deflection
        Deflection [arcsec], [..., ny, nx]; usually [2, ny, nx] as (x, y).
    sigma_arcsec
        Standard deviation of the Gaussian [arcsec]; the paper's phi_min = 0.4".
    pixel_scale
        Side of a pixel [arcsec].
    kind
        "gaussian": minus its convolution with the Gaussian. "starlet": the isotropic undecimated wavelet
        transform with the B3 spline up to the matching scale. "median_wavelet": the multiresolution median
        transform up to the matching scale; it is not linear.

    Notes
    -----
    Within `margin_pixels` of the edge the result depends on what lies beyond, where the last pixel is repeated:
    pass a padded field and `crop` it.

    Reference: Birrer+2017 sec. 3.2, Delta alpha_dm = alpha_dm - alpha_dm * g(phi_min), and its footnote.
    """
    sigma = _in_pixels(sigma_arcsec, pixel_scale, kind)
    if not np.isfinite(deflection).all():
        raise ValueError("deflection must be finite")
    if kind == "gaussian":
        radius = margin_pixels(sigma_arcsec, pixel_scale)
        smoothed = ndimage.gaussian_filter(deflection, sigma, axes=(-2, -1), mode="nearest", radius=radius)
    elif kind == "starlet":
        smoothed = _starlet_smooth(deflection, _starlet_steps(sigma))
    else:
        smoothed = _median_smooth(deflection, _median_half_widths(sigma))
    return deflection - smoothed


def crop(field: FloatArray, margin: int) -> FloatArray:
    """Return the field [..., ny, nx] without `margin` pixels on every side; undoes `PixelGrid.padded`."""
    ny, nx = field.shape[-2:]
    if margin < 0 or 2 * margin >= min(ny, nx):
        raise ValueError(f"margin must be >= 0 and leave a pixel of the {ny} x {nx} field, got {margin}")
    return field[..., margin : ny - margin, margin : nx - margin]


def _in_pixels(sigma_arcsec: float, pixel_scale: float, kind: FilterKind) -> float:
    if kind not in get_args(FilterKind):
        raise ValueError(f"deflections.filter must be one of {', '.join(get_args(FilterKind))}, got {kind!r}")
    if not (0.0 < sigma_arcsec < np.inf and 0.0 < pixel_scale < np.inf):
        raise ValueError(
            f"sigma_arcsec and pixel_scale must be finite and > 0, got {sigma_arcsec!r} and {pixel_scale!r}"
        )
    return sigma_arcsec / pixel_scale


def _starlet_steps(sigma: float) -> list[int]:
    """Return the distances of the spline's taps per scale, 1, 2, 4, ..., for a width nearest to sigma [pixel]."""
    candidates = [[2**j for j in range(n)] for n in range(1, _MAX_SCALES + 1)]
    return _nearest(candidates, [_starlet_sigma(steps) for steps in candidates], sigma)


def _starlet_sigma(steps: Sequence[int]) -> float:
    return math.sqrt(sum(step**2 for step in steps))  # the spline of step d has the variance d^2


def _starlet_smooth(field: FloatArray, steps: Sequence[int]) -> FloatArray:
    """Return the last a-trous smoothing: c_(j+1) = h_j * c_j, with h_j the B3 spline with 2^j - 1 holes."""
    for step in steps:
        kernel = np.zeros(4 * step + 1)
        kernel[::step] = _B3_SPLINE
        for axis in (-2, -1):
            field = ndimage.convolve1d(field, kernel, axis=axis, mode="nearest")
    return field


def _median_half_widths(sigma: float) -> list[int]:
    """Return the half-widths of the median windows, s, 2 s, 4 s, ..., for a width nearest to sigma [pixel]."""
    candidates = [[s * 2**j for j in range(n)] for n in range(1, _MAX_SCALES + 1) for s in _MEDIAN_STARTS]
    return _nearest(candidates, [_median_sigma(widths) for widths in candidates], sigma)


def _median_sigma(half_widths: Sequence[int]) -> float:
    return math.sqrt(sum(((2 * s + 1) ** 2 - 1) / 12.0 for s in half_widths))  # of uniform windows of 2 s + 1


def _median_smooth(field: FloatArray, half_widths: Sequence[int]) -> FloatArray:
    """Return the last smoothing of the median transform: c_(j+1) = med(c_j; 2 s_j + 1), s_(j+1) = 2 s_j."""
    for s in half_widths:
        field = ndimage.median_filter(field, size=2 * s + 1, axes=(-2, -1), mode="nearest")
    return field


def _nearest(candidates: list[list[int]], widths: list[float], sigma: float) -> list[int]:
    """Return the candidate whose width is nearest in ratio to sigma [pixel]."""
    if not widths[0] / math.sqrt(2.0) <= sigma <= widths[-1]:
        raise ValueError(
            f"deflections.filter_arcsec is {sigma:.3g} pixels, the scales of this filter are {widths[0]:.3g} to "
            f"{widths[-1]:.3g} pixels wide; change filter_arcsec, or use deflections.filter: gaussian"
        )
    return candidates[int(np.argmin([abs(math.log(width / sigma)) for width in widths]))]
