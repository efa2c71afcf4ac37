"""Mock images: source light along bent rays, blurred by the PSF."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import Convolution
from warmlens.imaging.shapelets import ShapeletSet, surface_brightness
from warmlens.types import FloatArray


def subpixel_field(field: FloatArray, factor: int) -> FloatArray:
    """Interpolate a field on pixel centres [..., ny, nx] to sub-pixel centres [..., ny * nx, factor**2].

    By a cubic spline that repeats the last pixel beyond the edges; the identity for factor 1.
    """
    *lead, ny, nx = field.shape
    if factor == 1:
        return field.reshape(*lead, ny * nx, 1)
    columns, rows = PixelGrid(ny, nx, 1.0, 0.0, 0.0).subpixel_coordinates(factor)
    planes = [
        ndimage.map_coordinates(plane, [rows, columns], order=3, mode="nearest")
        for plane in field.reshape(-1, ny, nx)
    ]
    return np.array(planes).reshape(*lead, ny * nx, factor**2)


def lensed_image(
    sets: Sequence[ShapeletSet],
    coefficients: FloatArray,
    source_x: FloatArray,
    source_y: FloatArray,
    convolution: Convolution,
) -> FloatArray:
    """Return the blurred image [ny, nx] [e-/s per pixel] of a shapelet source.

    Parameters
    ----------
    sets, coefficients
        Source basis and its amplitudes [n]: e-/s per pixel as the shapelets are evaluated.
    source_x, source_y
        Source positions of the rays, [ny * nx, n_sub] [arcsec]; sub-pixels are averaged.
    """
    light = surface_brightness(sets, coefficients, source_x.ravel(), source_y.ravel())
    return convolution.forward(light.reshape(source_x.shape).mean(axis=1).reshape(convolution.shape))


def bent_rays(rays: tuple[FloatArray, FloatArray], delta_alpha: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return source positions (x, y) [ny * nx, n_sub] [arcsec] of rays that substructure bends too.

    With alpha_mock = alpha_smooth + Delta alpha (Birrer+2017 sec. 3.2) the source position of a ray moves by
    -Delta alpha.

    Parameters
    ----------
    rays
        Source positions (x, y) under the smooth lens.
    delta_alpha
        Deflection of the substructure at the sub-pixels, [2, ny * nx, n_sub] [arcsec].
    """
    return rays[0] - delta_alpha[0], rays[1] - delta_alpha[1]
