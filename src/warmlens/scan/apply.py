"""The scan of a batch of images: Delta R and linear response, the operator applied to their smooth fits."""

from __future__ import annotations

import math

import numpy as np

from warmlens.imaging.shapelets import basis as shapelet_basis
from warmlens.imaging.source_gradient import gradient_sets
from warmlens.kernels import njit
from warmlens.scan.forms import fill_change, unpack
from warmlens.scan.nested import nested_basis, nested_block
from warmlens.scan.perturber import PerturbedBasis, deflection_over_radius, position_blocks
from warmlens.scan.response import LinearResponse, check_response
from warmlens.scan.shard import OperatorShard, ScanBand, active_positions, n_functions, stack_rows
from warmlens.types import FloatArray, IntArray


def delta_r(
    shard: OperatorShard, band: ScanBand, source_coefficients: FloatArray, back_projected: FloatArray
) -> FloatArray:
    """Delta R = J_pert - J_smooth of every position and mock, one band (docs/scan.md).

    Parameters
    ----------
    shard, band
        Operator of the positions, and the band that it was built for.
    source_coefficients
        Coefficients of the unscaled source columns of the smooth fits, the first n_source rows of
        `physical_coefficients` [n_source, k].
    back_projected
        Residuals of the same fits, from `residual_images` [npix, k]; tau in docs/scan.md.

    Returns
    -------
    FloatArray
        [n_positions, k], in units of chi2; exactly 0 where the perturber moves no unmasked pixel.
    """
    return _scan(shard, band, source_coefficients, back_projected, response=False)[0]


def delta_r_and_response(
    shard: OperatorShard, band: ScanBand, source_coefficients: FloatArray, back_projected: FloatArray
) -> tuple[FloatArray, LinearResponse]:
    """`delta_r` and the score and Fisher information [n_positions, k] of the same images; noise [n_positions, 1].

    Most of the work is the same. The shard must have been built with its response.
    """
    check_response(shard)
    maps, score, fisher = _scan(shard, band, source_coefficients, back_projected, response=True)
    return maps, LinearResponse(score, fisher, shard.response_noise[:, None])


def _scan(
    shard: OperatorShard,
    band: ScanBand,
    source_coefficients: FloatArray,
    back_projected: FloatArray,
    *,
    response: bool,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    basis, nested = band.basis(), nested_basis(shard.nested_n_max, band.rays, band.perturber)
    source_coefficients = np.ascontiguousarray(source_coefficients, dtype=np.float64)
    back_projected = np.ascontiguousarray(back_projected, dtype=np.float64)
    _check_fits(basis, source_coefficients, back_projected)
    raised, along_x, along_y = gradient_sets(band.sets, source_coefficients)
    source_x, source_y = band.rays.source_x, band.rays.source_y
    maps = np.zeros((shard.n_positions, back_projected.shape[1]))
    score, fisher = np.zeros_like(maps), np.zeros_like(maps)
    for span in position_blocks(shard.pixel_offsets):
        w = position_vectors(shard, basis, nested, span, source_coefficients, back_projected)
        _apply(shard, span, w, maps)
        if response:
            moved = shard.pixels[shard.pixel_offsets[span[0]] : shard.pixel_offsets[span[1]]]
            # a pixel is moved by several positions, and the source's gradient there is the same for all of them
            different, rows = np.unique(moved, return_inverse=True)
            columns = shapelet_basis(raised, source_x[different].ravel(), source_y[different].ravel())
            shape = different.size, source_x.shape[1], back_projected.shape[1]
            slope_x, slope_y = ((columns @ along).reshape(shape) for along in (along_x, along_y))
            delta_slope = _slopes(basis, shard, span, rows, slope_x, slope_y)
            _respond(shard, shard.response_offsets, span, w, delta_slope, score, fisher)
    return maps, score, fisher


def _check_fits(basis: PerturbedBasis, source_coefficients: FloatArray, back_projected: FloatArray) -> None:
    """Refuse coefficients [n_source, k] and back-projected residuals [npix, k] that do not fit."""
    if source_coefficients.ndim != 2 or source_coefficients.shape[0] != basis.n_coef:
        raise ValueError(
            f"source_coefficients must be [n_source, k] with n_source = {basis.n_coef} for these sets, "
            f"got {source_coefficients.shape}"
        )
    expected = basis.theta_x.shape[0], source_coefficients.shape[1]
    if back_projected.shape != expected:
        raise ValueError(
            f"back_projected must be [npix, k] = [{expected[0]}, {expected[1]}], got {back_projected.shape}"
        )


def position_vectors(
    shard: OperatorShard,
    basis: PerturbedBasis,
    nested: PerturbedBasis,
    span: tuple[int, int],
    source_coefficients: FloatArray,
    back_projected: FloatArray,
) -> FloatArray:
    """Return w = [delta; t; rho_s] of k smooth fits at the positions of a span [sum of 2m + n_nested, k].

    Parameters
    ----------
    shard
        Operator of the positions.
    basis, nested
        `ScanBand.basis` and `nested_basis` as `build_shard` had them.
    span
        First position and last + 1; some ten of them are fastest, see `position_blocks`.
    source_coefficients, back_projected
        Coefficients of the unscaled source columns [n_source, k], back-projected residuals [npix, k].
    """
    offsets = shard.pixel_offsets[span[0] : span[1] + 1]
    moved = shard.pixels[offsets[0] : offsets[-1]]
    change = np.zeros((moved.size, basis.n_coef))
    fill_change(basis, shard, span, False, change)
    seen, columns = nested_block(nested, shard.points[slice(*span)][np.diff(offsets) > 0])
    delta, rho = change @ source_coefficients, columns @ back_projected[seen]
    return stack_rows(shard.pixel_offsets, span, nested.n_coef, delta, back_projected[moved], rho)


@njit(cache=True)
def _apply(shard: OperatorShard, span: tuple[int, int], vectors: FloatArray, out: FloatArray) -> None:
    n_nested = n_functions(shard.nested_n_max)
    for position, m, row in active_positions(shard.pixel_offsets, span, n_nested):
        w = vectors[row : row + 2 * m + n_nested]
        Qw = np.dot(unpack(shard.matrices, shard.matrix_offsets[position], w.shape[0]), w)
        for i in range(w.shape[0]):
            for fit in range(w.shape[1]):
                out[position, fit] += w[i, fit] * Qw[i, fit]  # Delta R = w.Q w


@njit(cache=True)
def _slopes(
    basis: PerturbedBasis,
    shard: OperatorShard,
    span: tuple[int, int],
    rows: IntArray,
    slope_x: FloatArray,
    slope_y: FloatArray,
) -> FloatArray:
    """Return delta' = dB' x of the positions of a span, one below the other [moved pixels, k].

    That is minus the mean over the sub-pixels of deflection times gradient. `slope_x`, `slope_y` are the sources'
    gradients [different pixels, sub-pixel, k]; `rows` finds those of each moved pixel.
    """
    n_sub, n_fits = slope_x.shape[1], slope_x.shape[2]
    base = shard.pixel_offsets[span[0]]
    out = np.zeros((shard.pixel_offsets[span[1]] - base, n_fits))
    for position in range(span[0], span[1]):
        for k in range(shard.pixel_offsets[position], shard.pixel_offsets[position + 1]):
            pixel, row = shard.pixels[k], rows[k - base]
            for sub in range(n_sub):
                dx = basis.theta_x[pixel, sub] - shard.positions[position, 0]
                dy = basis.theta_y[pixel, sub] - shard.positions[position, 1]
                radius = math.sqrt(dx * dx + dy * dy)
                ratio = deflection_over_radius(radius, basis.theta_e, basis.r_trunc) / n_sub
                for fit in range(n_fits):
                    out[k - base, fit] -= ratio * (dx * slope_x[row, sub, fit] + dy * slope_y[row, sub, fit])
    return out


@njit(cache=True)
def _respond(
    shard: OperatorShard,
    response_offsets: IntArray,
    span: tuple[int, int],
    vectors: FloatArray,
    slopes: FloatArray,
    score: FloatArray,
    fisher: FloatArray,
) -> None:
    n_nested = n_functions(shard.nested_n_max)
    for position, m, row in active_positions(shard.pixel_offsets, span, n_nested):
        start, stop = response_offsets[position], response_offsets[position + 1]
        done = shard.pixel_offsets[position] - shard.pixel_offsets[span[0]]
        v = np.empty((2 * m, vectors.shape[1]))  # [delta'; t] of the smooth fit
        for i in range(m):
            for fit in range(v.shape[1]):
                v[i, fit] = slopes[done + i, fit]
                v[m + i, fit] = vectors[row + m + i, fit]
        if n_nested > 0:
            R = shard.responses[start + m * (m + 1) // 2 : stop].copy().reshape(2 * m, n_nested)
            v += np.dot(R, vectors[row + 2 * m : row + 2 * m + n_nested])  # of the fit with the nested shapelets
        Kd = np.dot(unpack(shard.responses, start, m), v[:m])
        for i in range(m):
            for fit in range(v.shape[1]):
                score[position, fit] += v[i, fit] * v[m + i, fit]  # s = t . delta'
                fisher[position, fit] += v[i, fit] * Kd[i, fit]  # F = delta' . K delta'
        for fit in range(v.shape[1]):
            fisher[position, fit] = max(fisher[position, fit], 0.0)
