"""Gradient of a shapelet source in the source plane."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warmlens.imaging.shapelets import ShapeletSet, surface_brightness
from warmlens.types import FloatArray


def source_gradient(
    sets: Sequence[ShapeletSet], coefficients: FloatArray, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives (dS/dx, dS/dy) of the surface brightness at the given rays.

    Parameters
    ----------
    sets, coefficients, x, y
        As `surface_brightness` takes them.

    Returns
    -------
    tuple
        Two arrays of the shape of `x`, in the unit of the coefficients per arcsec.
    """
    raised, along_x, along_y = gradient_sets(sets, coefficients)
    return surface_brightness(raised, along_x, x, y), surface_brightness(raised, along_y, x, y)


def gradient_sets(
    sets: Sequence[ShapeletSet], coefficients: FloatArray
) -> tuple[tuple[ShapeletSet, ...], FloatArray, FloatArray]:
    """The gradient as shapelets: sets one order higher, and coefficients of dS/dx and dS/dy.

    Parameters
    ----------
    sets
        Shapelet sets of the source.
    coefficients
        [n_coef], or [n_coef, k] of k sources; those of the gradient likewise.

    Notes
    -----
    phi_n' = sqrt(n/2) phi_(n-1) - sqrt((n+1)/2) phi_(n+1)  (Refregier 2003, eq. 26), so the gradient is itself
    a sum of shapelets, one order higher.
    """
    raised, along_x, along_y = [], [], []
    start = 0
    for item in sets:
        stop = start + item.n_coefficients
        higher = ShapeletSet(item.n_max + 1, item.beta, item.center_x, item.center_y)
        n1, n2 = np.array(item.orders()).T
        # coefficients as [n1, n2], with a margin of zeros
        table = np.zeros((item.n_max + 3, item.n_max + 3, *coefficients.shape[1:]))
        table[n1, n2] = coefficients[start:stop]
        n1, n2 = np.array(higher.orders()).T
        along_x.append(_derivative(table, n1, n2) / item.beta)
        along_y.append(_derivative(np.swapaxes(table, 0, 1), n2, n1) / item.beta)
        raised.append(higher)
        start = stop
    return tuple(raised), np.concatenate(along_x), np.concatenate(along_y)


def _derivative(table: FloatArray, n: np.ndarray, other: np.ndarray) -> FloatArray:
    """Coefficients of the derivative along the first axis: c'_n = sqrt((n+1)/2) c_(n+1) - sqrt(n/2) c_(n-1)."""
    up, down = (np.sqrt(0.5 * factor).reshape(-1, *[1] * (table.ndim - 2)) for factor in (n + 1, n))
    return up * table[n + 1, other] - down * table[n - 1, other]  # for n = 0 down is 0
