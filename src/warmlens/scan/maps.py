"""Residuals: the images that a scan starts from, and the maps R_smooth, R_pert and R_sens of both fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from warmlens.fitting.linear import LinearFit, LinearModel, physical_coefficients
from warmlens.imaging.psf import Convolution
from warmlens.imaging.shapelets import ShapeletSet
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.forms import unpack
from warmlens.scan.nested import nested_basis
from warmlens.scan.operator import OperatorShard
from warmlens.scan.perturber import Perturber, perturbed_basis, position_blocks
from warmlens.scan.vectors import check_fits, position_vectors
from warmlens.types import FloatArray, IntArray


@dataclass(frozen=True)
class ResidualMaps:
    """Weighted squared differences of image and models (Birrer+2017 sec. 4.1), each [n_positions, k].

    Attributes
    ----------
    r_smooth, r_pert
        |d - model|^2 of the fits without and with the perturber.
    r_sens
        |model_pert - model_smooth|^2.
    """

    r_smooth: FloatArray
    r_pert: FloatArray
    r_sens: FloatArray


def residual_images(fit: LinearFit, convolution: Convolution, weights: FloatArray) -> FloatArray:
    """Back-projected residuals tau = P^T W r of k fits [npix, k], the mocks of a pixel side by side.

    Parameters
    ----------
    fit
        Smooth fits of one band.
    convolution, weights
        PSF convolution of the band and 1/sigma [ny, nx].
    """
    npix = fit.residual.shape[0]
    if npix != weights.size or weights.shape != convolution.shape:
        raise ValueError(
            f"residuals of {npix} pixels, weights {weights.shape} and a convolution of {convolution.shape} "
            "do not belong to one image"
        )
    return _back_projected(fit.residual, convolution, weights)


def _back_projected(whitened: FloatArray, convolution: Convolution, weights: FloatArray) -> FloatArray:
    """P^T W times each column of whitened images [npix, k]."""
    npix, n_fits = whitened.shape
    images = np.ascontiguousarray((weights.reshape(npix, 1) * whitened).T)
    tau = convolution.adjoint(images.reshape(n_fits, *convolution.shape))
    return np.ascontiguousarray(tau.reshape(n_fits, npix).T)


def residual_maps(
    shard: OperatorShard,
    model: LinearModel,
    fit: LinearFit,
    sets: tuple[ShapeletSet, ...],
    rays: SmoothRays,
    perturber: Perturber,
    convolution: Convolution,
    weights: FloatArray,
) -> ResidualMaps:
    """R_smooth, R_pert and R_sens of every position and fit, one band (docs/scan.md).

    They are sums over the pixels; Delta R of `delta_r` is the difference of the minima J, which contain the
    penalty of the priors. Where the perturber moves no unmasked pixel both fits are the one without nested
    shapelets, and R_sens is 0.

    Parameters
    ----------
    shard, sets, rays, perturber
        As for `delta_r`.
    model, fit
        Linear model of the band and k smooth fits by it.
    convolution, weights
        PSF convolution of the band and 1/sigma [ny, nx].
    """
    if shard.sensitivity.size != shard.matrices.size:
        raise ValueError("the shard was read without its sensitivity, which residual maps need; read it with")
    tau = residual_images(fit, convolution, weights)
    # The prior keeps A^T r = Lambda x from being 0: with it come dB, E and N_s^T applied to the fit's "pull".
    pull = model.inverse_factor.T @ (model.inverse_factor @ (model.prior[:, None] * fit.coefficients))
    pull_tau = _back_projected(model.design @ pull, convolution, weights)
    basis, nested = perturbed_basis(sets, rays, perturber), nested_basis(shard.nested_n_max, rays, perturber)
    coefficients, pull_coefficients = (
        np.ascontiguousarray(physical_coefficients(model, x)[: model.n_source]) for x in (fit.coefficients, pull)
    )
    check_fits(basis, coefficients, tau)
    out = np.zeros((3, shard.n_positions, fit.chi2.size))
    out[:2] = fit.chi2
    for first, last in position_blocks(shard.pixel_offsets):
        _add_residuals(
            shard.pixel_offsets,
            shard.matrix_offsets,
            shard.matrices,
            shard.sensitivity,
            shard.nested_inverse,
            first,
            last,
            nested.n_coef,
            position_vectors(shard, basis, nested, (first, last), coefficients, tau),
            position_vectors(shard, basis, nested, (first, last), pull_coefficients, pull_tau),
            out,
        )
    return ResidualMaps(out[0], out[1], out[2])


@njit(cache=True)
def _add_residuals(
    pixel_offsets: IntArray,
    matrix_offsets: IntArray,
    matrices: FloatArray,
    sensitivity: FloatArray,
    nested_inverse: FloatArray,
    first: int,
    last: int,
    n_nested: int,
    vectors: FloatArray,
    pulls: FloatArray,
    out: FloatArray,
) -> None:
    """Add what the nested shapelets and the perturber change to R_smooth, R_pert, R_sens [3, n_positions, k]."""
    row = 0
    for position in range(first, last):
        m = pixel_offsets[position + 1] - pixel_offsets[position]
        if m == 0:
            continue
        size = 2 * m + n_nested
        w, pull = vectors[row : row + size], pulls[row : row + size]
        gamma = unpack(sensitivity, matrix_offsets[position], size)
        smooth = np.zeros_like(w)  # a_s = [0; 0; -C_s^-1 rho_s]
        if n_nested > 0:
            smooth[2 * m :] = -np.dot(unpack(nested_inverse[position], 0, n_nested), w[2 * m :])
        step = np.dot(unpack(matrices, matrix_offsets[position], size), w)  # e = a_p - a_s = Q w
        gamma_smooth, gamma_step = np.dot(gamma, smooth), np.dot(gamma, step)
        for i in range(size):
            for fit in range(w.shape[1]):
                # b = Phi^T r = [-dB pull; pull_t - t; pull_rho - rho_s]
                b = -pull[i, fit] if i < m else pull[i, fit] - w[i, fit]
                change = smooth[i, fit] * (gamma_smooth[i, fit] - 2.0 * b)
                out[0, position, fit] += change
                out[1, position, fit] += change
                out[1, position, fit] += step[i, fit] * (gamma_step[i, fit] + 2.0 * gamma_smooth[i, fit] - 2.0 * b)
                out[2, position, fit] += step[i, fit] * gamma_step[i, fit]  # R_sens = (Q w).Gamma (Q w)
        row += size
