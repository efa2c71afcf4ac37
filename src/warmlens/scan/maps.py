"""Residuals: the images that a scan starts from, and the maps R_smooth, R_pert and R_sens of both fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warmlens.fitting.linear import LinearFit, physical_coefficients
from warmlens.imaging.psf import Convolution
from warmlens.kernels import njit
from warmlens.scan.apply import position_vectors
from warmlens.scan.forms import unpack
from warmlens.scan.nested import nested_basis
from warmlens.scan.perturber import position_blocks
from warmlens.scan.shard import OperatorShard, ScanBand, active_positions, n_functions
from warmlens.types import FloatArray


@dataclass(frozen=True)
class ResidualMaps:
    """Weighted squared differences of image and models (Birrer+2017 sec. 4.1), each [n_positions, k]."""

    # |d - model|^2 of the fits without and with the perturber
    r_smooth: FloatArray
    r_pert: FloatArray
    r_sens: FloatArray  # |model_pert - model_smooth|^2


def residual_images(fit: LinearFit, convolution: Convolution, weights: FloatArray) -> FloatArray:
    """Back-project the residuals of k fits, tau = P^T W r in docs/scan.md [npix, k], a pixel's mocks side by side.

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
    return _back_project(fit.residual, convolution, weights)


def _back_project(whitened: FloatArray, convolution: Convolution, weights: FloatArray) -> FloatArray:
    """Apply P^T W to each column of whitened images [npix, k]."""
    npix, n_fits = whitened.shape
    images = np.ascontiguousarray((weights.reshape(npix, 1) * whitened).T)
    back_projected = convolution.adjoint(images.reshape(n_fits, *convolution.shape))
    return np.ascontiguousarray(back_projected.reshape(n_fits, npix).T)


def residual_maps(shard: OperatorShard, band: ScanBand, fit: LinearFit) -> ResidualMaps:
    """R_smooth, R_pert and R_sens of every position and fit, one band (docs/scan.md).

    They are sums over the pixels; Delta R of `delta_r` is the difference of the minima J, which contain the
    penalty of the priors. Where the perturber moves no unmasked pixel both fits are the one without nested
    shapelets, and R_sens is 0.

    Parameters
    ----------
    shard, band
        Operator of the positions, and the band that it was built for.
    fit
        k smooth fits by the band's linear model.
    """
    if shard.sensitivity.size != shard.matrices.size:
        raise ValueError("the shard was read without its sensitivity, which residual maps need; read it with")
    model, convolution, weights = band.model, band.convolution, band.weights
    back_projected = residual_images(fit, convolution, weights)
    # The prior keeps A^T r = Lambda x from being 0: with it come dB, E and N_s^T applied to the fit's "pull".
    pull = model.inverse_factor.T @ (model.inverse_factor @ (model.prior[:, None] * fit.coefficients))
    pull_back_projected = _back_project(model.design @ pull, convolution, weights)
    basis, nested = band.basis(), nested_basis(shard.nested_n_max, band.rays, band.perturber)
    coefficients, pull_coefficients = (
        np.ascontiguousarray(physical_coefficients(model, x)[: model.n_source]) for x in (fit.coefficients, pull)
    )
    out = np.zeros((3, shard.n_positions, fit.chi2.size))
    out[:2] = fit.chi2
    for span in position_blocks(shard.pixel_offsets):
        w = position_vectors(shard, basis, nested, span, coefficients, back_projected)
        pulls = position_vectors(shard, basis, nested, span, pull_coefficients, pull_back_projected)
        _add_residuals(shard, span, w, pulls, out)
    return ResidualMaps(out[0], out[1], out[2])


@njit(cache=True)
def _add_residuals(
    shard: OperatorShard, span: tuple[int, int], vectors: FloatArray, pulls: FloatArray, out: FloatArray
) -> None:
    """Add what the nested shapelets and the perturber change to R_smooth, R_pert, R_sens [3, n_positions, k]."""
    n_nested = n_functions(shard.nested_n_max)
    for position, m, row in active_positions(shard.pixel_offsets, span, n_nested):
        size = 2 * m + n_nested
        w, pull = vectors[row : row + size], pulls[row : row + size]
        gamma = unpack(shard.sensitivity, shard.matrix_offsets[position], size)
        smooth = np.zeros_like(w)  # a_s = [0; 0; -C_s^-1 rho_s]
        if n_nested > 0:
            smooth[2 * m :] = -np.dot(unpack(shard.nested_inverse[position], 0, n_nested), w[2 * m :])
        step = np.dot(unpack(shard.matrices, shard.matrix_offsets[position], size), w)  # e = a_p - a_s = Q w
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
