"""Scan maps: the operator applied to the fits of a batch of mocks (or of the observation)."""

from __future__ import annotations

import numpy as np
from numba import njit

from warmlens.fitting.linear import LinearFit
from warmlens.imaging.psf import Convolution
from warmlens.imaging.shapelets import ShapeletSet
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.operator import OperatorShard
from warmlens.scan.perturber import PerturbedBasis, Perturber, basis_change, perturbed_basis
from warmlens.types import FloatArray, IntArray


def residual_images(fit: LinearFit, convolution: Convolution, weights: FloatArray) -> FloatArray:
    """Back-projected residuals tau = P^T W r of k fits [npix, k], the mocks of a pixel side by side.

    Parameters
    ----------
    fit
        Smooth fits of one band.
    convolution, weights
        PSF convolution of the band and 1/sigma [ny, nx].
    """
    npix, n_fits = fit.residual.shape
    if npix != weights.size or weights.shape != convolution.shape:
        raise ValueError(
            f"residuals of {npix} pixels, weights {weights.shape} and a convolution of {convolution.shape} "
            "do not belong to one image"
        )
    images = np.ascontiguousarray((weights.reshape(npix, 1) * fit.residual).T)
    tau = convolution.adjoint(images.reshape(n_fits, *convolution.shape))
    return np.ascontiguousarray(tau.reshape(n_fits, npix).T)


def delta_r(
    shard: OperatorShard,
    sets: tuple[ShapeletSet, ...],
    rays: SmoothRays,
    perturber: Perturber,
    source_coefficients: FloatArray,
    tau: FloatArray,
) -> FloatArray:
    """Delta R = J_pert - J_smooth of every position and mock, one band (docs/scan.md, no nested shapelets).

    Parameters
    ----------
    shard
        Operator of the positions.
    sets, rays, perturber
        As `build_shard` had them.
    source_coefficients
        Coefficients of the unscaled source columns of the smooth fits, the first n_source rows of
        `physical_coefficients` [n_source, k].
    tau
        `residual_images` of the same fits [npix, k].

    Returns
    -------
    FloatArray
        [n_positions, k], in units of chi2; exactly 0 where the perturber moves no unmasked pixel.
    """
    basis = perturbed_basis(sets, rays, perturber)
    source_coefficients = np.ascontiguousarray(source_coefficients, dtype=np.float64)
    tau = np.ascontiguousarray(tau, dtype=np.float64)
    if source_coefficients.ndim != 2 or source_coefficients.shape[0] != basis.n_coef:
        raise ValueError(
            f"source_coefficients must be [n_source, k] with n_source = {basis.n_coef} for these sets, "
            f"got {source_coefficients.shape}"
        )
    npix, n_fits = rays.theta_x.shape[0], source_coefficients.shape[1]
    if tau.shape != (npix, n_fits):
        raise ValueError(f"tau must be [npix, k] = [{npix}, {n_fits}], got {tau.shape}")
    return _apply(
        basis,
        shard.positions,
        shard.pixel_offsets,
        shard.pixels,
        shard.matrix_offsets,
        shard.matrices,
        source_coefficients,
        tau,
    )


@njit(cache=True)
def _apply(
    basis: PerturbedBasis,
    positions: FloatArray,
    pixel_offsets: IntArray,
    pixels: IntArray,
    matrix_offsets: IntArray,
    matrices: FloatArray,
    coefficients: FloatArray,
    tau: FloatArray,
) -> FloatArray:
    n_fits = coefficients.shape[1]
    out = np.zeros((positions.shape[0], n_fits))
    for position in range(positions.shape[0]):
        start, stop = pixel_offsets[position], pixel_offsets[position + 1]
        m = stop - start
        if m == 0:
            continue
        moved = pixels[start:stop]
        change = basis_change(basis, positions[position, 0], positions[position, 1], moved)
        v = np.empty((2 * m, n_fits))
        v[:m] = np.dot(change.T, coefficients)  # delta = dB x
        for i in range(m):
            v[m + i] = tau[moved[i]]  # t
        M = np.empty((2 * m, 2 * m))
        k = matrix_offsets[position]
        for i in range(2 * m):
            for j in range(i + 1):
                M[i, j] = matrices[k]
                M[j, i] = matrices[k]
                k += 1
        Mv = np.dot(M, v)
        for i in range(2 * m):
            for fit in range(n_fits):
                out[position, fit] += v[i, fit] * Mv[i, fit]  # J_pert - J_smooth = v.M v
    return out
