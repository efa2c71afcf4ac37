"""Gradient of a shapelet source in the source plane."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warmlens.imaging.shapelets import ShapeletSet, surface_brightness
from warmlens.types import FloatArray, IntArray


def source_gradient(
    sets: Sequence[ShapeletSet], coefficients: FloatArray, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives (dS/dx, dS/dy) of `surface_brightness`, in its unit per arcsec."""
    raised, along_x, along_y = gradient_sets(sets, coefficients)
    return surface_brightness(raised, along_x, x, y), surface_brightness(raised, along_y, x, y)


def gradient_sets(
    sets: Sequence[ShapeletSet], coefficients: FloatArray
) -> tuple[tuple[ShapeletSet, ...], FloatArray, FloatArray]:
    """Return the gradient as shapelets: sets one order higher, and coefficients of dS/dx and dS/dy.

    The coefficients are [n_coef], or [n_coef, k] of k sources, and those of the gradient likewise. Since
    phi_n' = sqrt(n/2) phi_(n-1) - sqrt((n+1)/2) phi_(n+1)  (Refregier 2003, eq. 26), the gradient of a sum of
    shapelets is a sum of shapelets, one order higher.
    """
    raised, along_x, along_y = [], [], []
    start = 0
    for shapelets in sets:
        stop = start + shapelets.n_coefficients
        higher = ShapeletSet(shapelets.n_max + 1, shapelets.beta, shapelets.center_x, shapelets.center_y)
        n1, n2 = np.array(shapelets.orders()).T
        # coefficients as [n1, n2], with a margin of zeros
        table = np.zeros((shapelets.n_max + 3, shapelets.n_max + 3, *coefficients.shape[1:]))
        table[n1, n2] = coefficients[start:stop]
        n1, n2 = np.array(higher.orders()).T
        along_x.append(_derivative(table, n1, n2) / shapelets.beta)
        along_y.append(_derivative(np.swapaxes(table, 0, 1), n2, n1) / shapelets.beta)
        raised.append(higher)
        start = stop
    return tuple(raised), np.concatenate(along_x), np.concatenate(along_y)


def _derivative(table: FloatArray, n: IntArray, other: IntArray) -> FloatArray:
    """Return the derivative along the first axis: c'_n = sqrt((n+1)/2) c_(n+1) - sqrt(n/2) c_(n-1)."""
    up, down = (np.sqrt(0.5 * factor).reshape(-1, *[1] * (table.ndim - 2)) for factor in (n + 1, n))
    return up * table[n + 1, other] - down * table[n - 1, other]  # for n = 0 down is 0
