"""Scan maps: the operator applied to the fits of a batch of mocks (or of the observation)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from warmlens.fitting.linear import LinearFit, LinearModel, physical_coefficients
from warmlens.imaging.psf import Convolution
from warmlens.imaging.shapelets import ShapeletSet
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.forms import unpack
from warmlens.scan.nested import gathered, nested_basis, nested_columns
from warmlens.scan.operator import OperatorShard
from warmlens.scan.perturber import PerturbedBasis, Perturber, basis_change, perturbed_basis
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


def delta_r(
    shard: OperatorShard,
    sets: tuple[ShapeletSet, ...],
    rays: SmoothRays,
    perturber: Perturber,
    source_coefficients: FloatArray,
    tau: FloatArray,
) -> FloatArray:
    """Delta R = J_pert - J_smooth of every position and mock, one band (docs/scan.md).

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
        nested_basis(shard.nested_n_max, rays, perturber),
        shard.positions,
        shard.points,
        shard.pixel_offsets,
        shard.pixels,
        shard.matrix_offsets,
        shard.matrices,
        source_coefficients,
        tau,
    )


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
    out = _residuals(
        perturbed_basis(sets, rays, perturber),
        nested_basis(shard.nested_n_max, rays, perturber),
        shard.positions,
        shard.points,
        shard.pixel_offsets,
        shard.pixels,
        shard.matrix_offsets,
        shard.matrices,
        shard.sensitivity,
        shard.nested_inverse,
        np.ascontiguousarray(physical_coefficients(model, fit.coefficients)[: model.n_source]),
        tau,
        np.ascontiguousarray(physical_coefficients(model, pull)[: model.n_source]),
        pull_tau,
        fit.chi2,
    )
    return ResidualMaps(out[0], out[1], out[2])


@njit(cache=True)
def _position_vector(
    basis: PerturbedBasis,
    nested: PerturbedBasis,
    position: FloatArray,
    point: FloatArray,
    moved: IntArray,
    coefficients: FloatArray,
    tau: FloatArray,
) -> FloatArray:
    """w = [delta; t; rho_s] of each fit [2m + n_nested, k]."""
    m = moved.size
    w = np.empty((2 * m + nested.n_coef, coefficients.shape[1]))
    change = basis_change(basis, position[0], position[1], moved)
    w[:m] = np.dot(change.T, coefficients)  # delta = dB x
    for i in range(m):
        w[m + i] = tau[moved[i]]  # t
    if nested.n_coef > 0:
        seen, columns = nested_columns(nested, point)
        w[2 * m :] = gathered(seen, columns, tau)  # rho_s = N_s^T tau
    return w


@njit(cache=True)
def _apply(
    basis: PerturbedBasis,
    nested: PerturbedBasis,
    positions: FloatArray,
    points: FloatArray,
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
        moved = pixels[pixel_offsets[position] : pixel_offsets[position + 1]]
        if moved.size == 0:
            continue
        w = _position_vector(basis, nested, positions[position], points[position], moved, coefficients, tau)
        Qw = np.dot(unpack(matrices, matrix_offsets[position], w.shape[0]), w)
        for i in range(w.shape[0]):
            for fit in range(n_fits):
                out[position, fit] += w[i, fit] * Qw[i, fit]  # Delta R = w.Q w
    return out


@njit(cache=True)
def _residuals(
    basis: PerturbedBasis,
    nested: PerturbedBasis,
    positions: FloatArray,
    points: FloatArray,
    pixel_offsets: IntArray,
    pixels: IntArray,
    matrix_offsets: IntArray,
    matrices: FloatArray,
    sensitivity: FloatArray,
    nested_inverse: FloatArray,
    coefficients: FloatArray,
    tau: FloatArray,
    pull_coefficients: FloatArray,
    pull_tau: FloatArray,
    chi2: FloatArray,
) -> FloatArray:
    """R_smooth, R_pert, R_sens [3, n_positions, k]."""
    n_fits = coefficients.shape[1]
    out = np.zeros((3, positions.shape[0], n_fits))
    for position in range(positions.shape[0]):
        out[0, position] = chi2
        out[1, position] = chi2
        moved = pixels[pixel_offsets[position] : pixel_offsets[position + 1]]
        m = moved.size
        if m == 0:
            continue
        place, point = positions[position], points[position]
        w = _position_vector(basis, nested, place, point, moved, coefficients, tau)
        pull = _position_vector(basis, nested, place, point, moved, pull_coefficients, pull_tau)
        gamma = unpack(sensitivity, matrix_offsets[position], w.shape[0])
        smooth = np.zeros_like(w)  # a_s = [0; 0; -C_s^-1 rho_s]
        if nested.n_coef > 0:
            smooth[2 * m :] = -np.dot(unpack(nested_inverse[position], 0, nested.n_coef), w[2 * m :])
        step = np.dot(unpack(matrices, matrix_offsets[position], w.shape[0]), w)  # e = a_p - a_s = Q w
        gamma_smooth, gamma_step = np.dot(gamma, smooth), np.dot(gamma, step)
        for i in range(w.shape[0]):
            for fit in range(n_fits):
                # b = Phi^T r = [-dB pull; pull_t - t; pull_rho - rho_s]
                b = -pull[i, fit] if i < m else pull[i, fit] - w[i, fit]
                out[0, position, fit] += smooth[i, fit] * (gamma_smooth[i, fit] - 2.0 * b)
                out[1, position, fit] += step[i, fit] * (gamma_step[i, fit] + 2.0 * gamma_smooth[i, fit] - 2.0 * b)
                out[2, position, fit] += step[i, fit] * gamma_step[i, fit]  # R_sens = (Q w).Gamma (Q w)
        out[1, position] += out[0, position] - chi2
    return out
