"""How an image enters the scan: the vector w = [delta; t; rho_s] of each position (docs/scan.md)."""

from __future__ import annotations

import numpy as np
from numba import njit

from warmlens.scan.forms import fill_change
from warmlens.scan.nested import nested_block
from warmlens.scan.operator import OperatorShard
from warmlens.scan.perturber import PerturbedBasis
from warmlens.types import FloatArray, IntArray


def check_fits(basis: PerturbedBasis, source_coefficients: FloatArray, tau: FloatArray) -> None:
    """Refuse coefficients [n_source, k] and back-projected residuals [npix, k] that do not fit.

    Raises
    ------
    ValueError
        Naming the shapes.
    """
    if source_coefficients.ndim != 2 or source_coefficients.shape[0] != basis.n_coef:
        raise ValueError(
            f"source_coefficients must be [n_source, k] with n_source = {basis.n_coef} for these sets, "
            f"got {source_coefficients.shape}"
        )
    expected = basis.theta_x.shape[0], source_coefficients.shape[1]
    if tau.shape != expected:
        raise ValueError(f"tau must be [npix, k] = [{expected[0]}, {expected[1]}], got {tau.shape}")


def position_vectors(
    shard: OperatorShard,
    basis: PerturbedBasis,
    nested: PerturbedBasis,
    span: tuple[int, int],
    source_coefficients: FloatArray,
    tau: FloatArray,
) -> FloatArray:
    """w of k smooth fits at the positions of a span, 2m + n_nested rows each, one below the other [rows, k].

    Parameters
    ----------
    shard
        Operator of the positions.
    basis, nested
        `perturbed_basis` and `nested_basis` as `build_shard` had them.
    span
        First position and last + 1; some ten of them are fastest, see `position_blocks`.
    source_coefficients, tau
        Coefficients of the unscaled source columns [n_source, k], back-projected residuals [npix, k].
    """
    first, last = span
    offsets = shard.pixel_offsets[first : last + 1]
    moved = shard.pixels[offsets[0] : offsets[-1]]
    change = np.zeros((moved.size, basis.n_coef))
    fill_change(basis, shard.positions, shard.pixel_offsets, shard.pixels, first, last, False, change)
    seen, columns = nested_block(nested, shard.points[first:last][np.diff(offsets) > 0])
    delta = change @ source_coefficients
    return _stacked(offsets, delta, tau[moved], columns @ tau[seen], nested.n_coef)


@njit(cache=True)
def _stacked(offsets: IntArray, delta: FloatArray, t: FloatArray, rho: FloatArray, n_nested: int) -> FloatArray:
    out = np.empty((2 * delta.shape[0] + rho.shape[0], delta.shape[1]))
    row, nested = 0, 0
    for position in range(offsets.size - 1):
        start, m = offsets[position] - offsets[0], offsets[position + 1] - offsets[position]
        if m == 0:
            continue
        for i in range(m):
            for fit in range(out.shape[1]):
                out[row + i, fit] = delta[start + i, fit]
                out[row + m + i, fit] = t[start + i, fit]
        for i in range(n_nested):
            for fit in range(out.shape[1]):
                out[row + 2 * m + i, fit] = rho[nested + i, fit]
        row += 2 * m + n_nested
        nested += n_nested
    return out
