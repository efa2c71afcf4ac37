"""The scan of a batch of images: Delta R and linear response, the operator applied to their smooth fits."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from warmlens.imaging.shapelets import ShapeletSet
from warmlens.imaging.shapelets import basis as shapelet_basis
from warmlens.imaging.source_gradient import gradient_sets
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.forms import unpack
from warmlens.scan.nested import nested_basis
from warmlens.scan.operator import OperatorShard
from warmlens.scan.perturber import (
    PerturbedBasis,
    Perturber,
    deflection_over_radius,
    perturbed_basis,
    position_blocks,
)
from warmlens.scan.response import LinearResponse, check_response
from warmlens.scan.vectors import check_fits, position_vectors
from warmlens.types import FloatArray, IntArray


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
    return _scan(shard, sets, rays, perturber, source_coefficients, tau, response=False)[0]


def delta_r_and_response(
    shard: OperatorShard,
    sets: tuple[ShapeletSet, ...],
    rays: SmoothRays,
    perturber: Perturber,
    source_coefficients: FloatArray,
    tau: FloatArray,
) -> tuple[FloatArray, LinearResponse]:
    """`delta_r` and the score and Fisher information [n_positions, k] of the same images; noise [n_positions, 1].

    Most of the work is the same. The shard must have been built with its response.
    """
    check_response(shard)
    found, score, fisher = _scan(shard, sets, rays, perturber, source_coefficients, tau, response=True)
    return found, LinearResponse(score, fisher, shard.response_noise[:, None])


def _scan(
    shard: OperatorShard,
    sets: tuple[ShapeletSet, ...],
    rays: SmoothRays,
    perturber: Perturber,
    source_coefficients: FloatArray,
    tau: FloatArray,
    *,
    response: bool,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    basis = perturbed_basis(sets, rays, perturber)
    nested = nested_basis(shard.nested_n_max, rays, perturber)
    source_coefficients = np.ascontiguousarray(source_coefficients, dtype=np.float64)
    tau = np.ascontiguousarray(tau, dtype=np.float64)
    check_fits(basis, source_coefficients, tau)
    raised, along_x, along_y = gradient_sets(sets, source_coefficients)
    found = np.zeros((shard.n_positions, tau.shape[1]))
    score, fisher = np.zeros_like(found), np.zeros_like(found)
    for first, last in position_blocks(shard.pixel_offsets):
        w = position_vectors(shard, basis, nested, (first, last), source_coefficients, tau)
        _apply(shard.pixel_offsets, shard.matrix_offsets, shard.matrices, first, last, nested.n_coef, w, found)
        if response:
            moved = shard.pixels[shard.pixel_offsets[first] : shard.pixel_offsets[last]]
            # a pixel is moved by several positions, and the source's gradient there is the same for all of them
            seen, rows = np.unique(moved, return_inverse=True)
            columns = shapelet_basis(raised, rays.source_x[seen].ravel(), rays.source_y[seen].ravel())
            shape = seen.size, rays.source_x.shape[1], tau.shape[1]
            slope_x, slope_y = ((columns @ along).reshape(shape) for along in (along_x, along_y))
            delta = _slopes(
                basis, shard.positions, shard.pixel_offsets, shard.pixels, first, last, rows, slope_x, slope_y
            )
            _respond(
                shard.pixel_offsets, shard.response_offsets, shard.responses, first, last, nested.n_coef, w, delta,
                score, fisher,
            )  # fmt: skip
    return found, score, fisher


@njit(cache=True)
def _apply(
    pixel_offsets: IntArray,
    matrix_offsets: IntArray,
    matrices: FloatArray,
    first: int,
    last: int,
    n_nested: int,
    vectors: FloatArray,
    out: FloatArray,
) -> None:
    row = 0
    for position in range(first, last):
        m = pixel_offsets[position + 1] - pixel_offsets[position]
        if m == 0:
            continue
        w = vectors[row : row + 2 * m + n_nested]
        Qw = np.dot(unpack(matrices, matrix_offsets[position], w.shape[0]), w)
        for i in range(w.shape[0]):
            for fit in range(w.shape[1]):
                out[position, fit] += w[i, fit] * Qw[i, fit]  # Delta R = w.Q w
        row += w.shape[0]


@njit(cache=True)
def _slopes(
    basis: PerturbedBasis,
    positions: FloatArray,
    pixel_offsets: IntArray,
    pixels: IntArray,
    first: int,
    last: int,
    rows: IntArray,
    slope_x: FloatArray,
    slope_y: FloatArray,
) -> FloatArray:
    """delta' = dB' x of the positions first..last-1, one below the other [moved pixels, k].

    That is minus the mean over the sub-pixels of deflection times gradient. `slope_x`, `slope_y` are the sources'
    gradients [seen, sub-pixel, k]; `rows` finds those of each moved pixel.
    """
    n_sub, n_fits = slope_x.shape[1], slope_x.shape[2]
    base = pixel_offsets[first]
    out = np.zeros((pixel_offsets[last] - base, n_fits))
    for position in range(first, last):
        for k in range(pixel_offsets[position], pixel_offsets[position + 1]):
            pixel, row = pixels[k], rows[k - base]
            for sub in range(n_sub):
                dx = basis.theta_x[pixel, sub] - positions[position, 0]
                dy = basis.theta_y[pixel, sub] - positions[position, 1]
                radius = math.sqrt(dx * dx + dy * dy)
                ratio = deflection_over_radius(radius, basis.theta_e, basis.r_trunc) / n_sub
                for fit in range(n_fits):
                    out[k - base, fit] -= ratio * (dx * slope_x[row, sub, fit] + dy * slope_y[row, sub, fit])
    return out


@njit(cache=True)
def _respond(
    pixel_offsets: IntArray,
    response_offsets: IntArray,
    responses: FloatArray,
    first: int,
    last: int,
    n_nested: int,
    vectors: FloatArray,
    slopes: FloatArray,
    score: FloatArray,
    fisher: FloatArray,
) -> None:
    row = 0
    for position in range(first, last):
        m = pixel_offsets[position + 1] - pixel_offsets[position]
        if m == 0:
            continue
        start, stop = response_offsets[position], response_offsets[position + 1]
        done = pixel_offsets[position] - pixel_offsets[first]
        v = np.empty((2 * m, vectors.shape[1]))  # [delta'; t] of the smooth fit
        for i in range(m):
            for fit in range(v.shape[1]):
                v[i, fit] = slopes[done + i, fit]
                v[m + i, fit] = vectors[row + m + i, fit]
        if n_nested > 0:
            R = responses[start + m * (m + 1) // 2 : stop].copy().reshape(2 * m, n_nested)
            v += np.dot(R, vectors[row + 2 * m : row + 2 * m + n_nested])  # of the fit with the nested shapelets
        Kd = np.dot(unpack(responses, start, m), v[:m])
        for i in range(m):
            for fit in range(v.shape[1]):
                score[position, fit] += v[i, fit] * v[m + i, fit]  # s = t . delta'
                fisher[position, fit] += v[i, fit] * Kd[i, fit]  # F = delta' . K delta'
        for fit in range(v.shape[1]):
            fisher[position, fit] = max(fisher[position, fit], 0.0)
        row += 2 * m + n_nested
