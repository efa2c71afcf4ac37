"""Compiled kernels of the operator: from the pieces of a position to its quadratic forms (docs/scan.md)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from warmlens.kernels import njit
from warmlens.scan.nested import at_point
from warmlens.scan.perturber import PerturbedBasis, basis_change, basis_response
from warmlens.scan.shard import OperatorShard, active_positions
from warmlens.types import FloatArray, IntArray


class Optics(NamedTuple):
    """What the band gives to every position."""

    # PSF, and 1/sigma [ny, nx]
    psf: FloatArray
    weights: FloatArray
    overlap: FloatArray  # table of `BandProjection.overlap`
    ridge: float  # of the nested shapelets; 0 without them


class Pieces(NamedTuple):
    """Columns of the positions of a span, one below the other.

    Attributes
    ----------
    rows, prior_rows
        Z^T = [Y, -G_E, -G N_s]^T and (Lambda^1/2 L^-T Z)^T [sum of 2m + n_nested, n].
    slopes, prior_slopes
        Y'^T and (Lambda^1/2 L^-T Y')^T [moved pixels, n] for the linear response; no row without it.
    images, convolved
        N_s^T and V_s^T = (W P N_s)^T of the positions that move something [n_active, n_nested, npix].
    """

    rows: FloatArray
    prior_rows: FloatArray
    slopes: FloatArray
    prior_slopes: FloatArray
    images: FloatArray
    convolved: FloatArray


@njit(cache=True)
def fill_change(
    basis: PerturbedBasis, shard: OperatorShard, span: tuple[int, int], slope: bool, out: FloatArray
) -> None:
    """Write dB, or its slope dB', of the positions of a span, one below the other, into the leading columns."""
    base = shard.pixel_offsets[span[0]]
    for position in range(span[0], span[1]):
        start, stop = shard.pixel_offsets[position], shard.pixel_offsets[position + 1]
        if stop > start:
            x, y = shard.positions[position]
            moved = shard.pixels[start:stop]
            change = basis_response(basis, x, y, moved) if slope else basis_change(basis, x, y, moved)
            out[start - base : stop - base, : basis.n_coef] = change.T


@njit(cache=True)
def fill_forms(
    shard: OperatorShard,
    response_offsets: IntArray,
    span: tuple[int, int],
    nested: PerturbedBasis,
    optics: Optics,
    pieces: Pieces,
) -> int:
    """Write Q, Gamma, C_s^-1 and, unless `responses` is empty, K, R and f of the positions of a span.

    Returns the first position whose nested columns are degenerate, -1 if there is none.
    """
    weights, ridge, n_nested = optics.weights, optics.ridge, nested.n_coef
    with_response = shard.responses.size > 0
    base = shard.pixel_offsets[span[0]]
    brightest = weights.max()
    for active, (position, m, row) in enumerate(active_positions(shard.pixel_offsets, span, n_nested)):
        start, stop = shard.pixel_offsets[position], shard.pixel_offsets[position + 1]
        moved = shard.pixels[start:stop]
        size = 2 * m + n_nested
        Z = pieces.rows[row : row + size]
        R = pieces.prior_rows[row : row + size]
        system = np.dot(Z, Z.T)
        form = -np.dot(R, R.T)  # Gamma of docs/scan.md, without the part that the system holds too
        form[:m, :m] += system[:m, :m]
        _subtract_overlap(system[m : 2 * m, m : 2 * m], optics.overlap, weights.shape[1], moved)
        for i in range(m):
            system[m + i, i] -= 1.0
            system[i, m + i] -= 1.0
        form[m : 2 * m, m : 2 * m] -= system[m : 2 * m, m : 2 * m]
        M = np.linalg.inv(system[: 2 * m, : 2 * m].copy())
        M = 0.5 * (M + M.T)
        Q = np.zeros((size, size))
        Q[: 2 * m, : 2 * m] = M
        K = -system[m : 2 * m, m : 2 * m]  # S - G_E^T G_E
        shift = np.zeros((n_nested, 2 * m))  # R^T
        scatter, prior_slope = np.zeros((m, m)), np.zeros((0, 0))
        if with_response:
            slope = pieces.slopes[start - base : stop - base]
            prior_slope = pieces.prior_slopes[start - base : stop - base].copy()
            scatter = np.dot(slope, slope.T)
        if n_nested > 0:
            V = pieces.convolved[active]  # [n_nested, npix]
            gram = np.dot(V, V.T)
            light = 0.0
            for i in range(n_nested):
                light = max(light, np.dot(pieces.images[active, i], pieces.images[active, i]))
            lam = ridge * np.diag(gram).max()
            # Only on masked pixels: V is all rounding of the FFT, and the columns are left out of both fits.
            if lam > ridge * 1e-24 * brightest**2 * light:
                UV = _convolved_products(optics.psf, weights, V, moved)
                here = at_point(nested, shard.points[position])
                x, y = shard.positions[position]
                change = basis_change(here, x, y, moved)  # dN^T
                # X = [-(G N_s)^T Y + dN^T, (G N_s)^T G_E - V_s^T U]
                X = system[2 * m :, : 2 * m].copy()
                X[:, :m] += change
                X[:, m:] -= UV.T
                C_s = gram - system[2 * m :, 2 * m :]
                form[2 * m :, 2 * m :] += C_s
                form[2 * m :, m : 2 * m] -= X[:, m:]
                for i in range(n_nested):
                    C_s[i, i] += lam
                XM = np.dot(X, M)
                gain = np.dot(XM, X.T)
                gain = 0.5 * (gain + gain.T)
                C_p = C_s + gain
                if np.linalg.eigvalsh(C_s)[0] <= 0.0 or np.linalg.eigvalsh(C_p)[0] <= 0.0:
                    return position
                inverse_s, inverse_p = np.linalg.inv(C_s), np.linalg.inv(C_p)
                cross = np.dot(inverse_p, XM)  # C_p^-1 X M
                Q[: 2 * m, : 2 * m] -= np.dot(XM.T, cross)
                Q[2 * m :, : 2 * m] = cross
                # C_s^-1 - C_p^-1 without the cancellation
                Q[2 * m :, 2 * m :] = np.dot(inverse_s, np.dot(gain, inverse_p))
                if with_response:
                    # R^T = C_s^-1 [X'_1, X_2], X'_1 = -(G N_s)^T Y' + dN'^T; K = S - G_E^T G_E - X_2^T C_s^-1 X_2
                    X_1 = basis_response(here, x, y, moved)  # dN'^T
                    X_1 += np.dot(Z[2 * m :], pieces.slopes[start - base : stop - base].T)
                    X_2 = X[:, m:].copy()
                    part = np.dot(inverse_s, X_1)
                    shift[:, :m] = part
                    scatter += np.dot(X_1.T, part) - lam * np.dot(part.T, part)
                    prior_slope += np.dot(part.T, R[2 * m :])
                    shift[:, m:] = np.dot(inverse_s, X_2)
                    K -= np.dot(X_2.T, shift[:, m:].copy())
                _pack(inverse_s, shard.nested_inverse[position])
            else:
                form[2 * m :] = 0.0
        # The lower triangles; above the diagonal Q[v, rho] and its like in Gamma were never filled.
        k = shard.matrix_offsets[position]
        for i in range(size):
            for j in range(i + 1):
                same = (i < 2 * m) or (j >= 2 * m)
                shard.matrices[k] = 0.5 * (Q[i, j] + Q[j, i]) if same else Q[i, j]
                shard.sensitivity[k] = form[i, j]
                k += 1
        if with_response:
            # f = tr(K Cov delta'): unit noise n in the data makes A N^-1 n of the fit, with the prior in N alone
            shard.response_noise[position] = np.sum(K * (scatter - np.dot(prior_slope, prior_slope.T)))
            k = response_offsets[position]
            k += _pack(K, shard.responses[k:])
            for i in range(2 * m):
                for j in range(n_nested):
                    shard.responses[k] = shift[j, i]
                    k += 1
    return -1


@njit(cache=True)
def _pack(matrix: FloatArray, out: FloatArray) -> int:
    """Write the lower triangle of a matrix that is symmetric up to rounding, row by row; return its size."""
    k = 0
    for i in range(matrix.shape[0]):
        for j in range(i + 1):
            out[k] = 0.5 * (matrix[i, j] + matrix[j, i])
            k += 1
    return k


@njit(cache=True)
def unpack(triangle: FloatArray, start: int, size: int) -> FloatArray:
    """Symmetric matrix [size, size] whose lower triangle lies row by row from `start` on."""
    out = np.empty((size, size))
    k = start
    for i in range(size):
        for j in range(i + 1):
            out[i, j] = triangle[k]
            out[j, i] = triangle[k]
            k += 1
    return out


@njit(cache=True)
def _subtract_overlap(block: FloatArray, overlap: FloatArray, n_columns: int, moved: IntArray) -> None:
    """Subtract S from a block, read from the table of `BandProjection.overlap`."""
    span = overlap.shape[0] - 1
    for i in range(moved.size):
        for j in range(i, moved.size):  # ascending pixels: j is in the same row as i or in a later one
            dy = moved[j] // n_columns - moved[i] // n_columns
            dx = moved[j] % n_columns - moved[i] % n_columns
            S_ij = overlap[dy, dx + span, moved[i]]
            block[j, i] -= S_ij
            if j > i:
                block[i, j] -= S_ij


@njit(cache=True)
def _convolved_products(psf: FloatArray, weights: FloatArray, V: FloatArray, moved: IntArray) -> FloatArray:
    """U^T V [m, n_nested]: U = W P E and V on the window that light of the moved pixels reaches."""
    n_rows, n_columns = weights.shape
    middle_y, middle_x = psf.shape[0] // 2, psf.shape[1] // 2
    rows, columns = moved // n_columns, moved % n_columns
    top, bottom = max(0, rows.min() - middle_y), min(n_rows, rows.max() + middle_y + 1)
    left, right = max(0, columns.min() - middle_x), min(n_columns, columns.max() + middle_x + 1)
    width = right - left
    U = np.zeros((moved.size, (bottom - top) * width))  # transposed
    for i in range(moved.size):
        start, stop = max(left, columns[i] - middle_x), min(right, columns[i] + middle_x + 1)
        for y in range(max(top, rows[i] - middle_y), min(bottom, rows[i] + middle_y + 1)):
            for x in range(start, stop):
                U[i, (y - top) * width + x - left] = (
                    weights[y, x] * psf[y - rows[i] + middle_y, x - columns[i] + middle_x]
                )
    V_window = np.empty((V.shape[0], U.shape[1]))
    for k in range(V.shape[0]):
        for y in range(top, bottom):
            for x in range(left, right):
                V_window[k, (y - top) * width + x - left] = V[k, y * n_columns + x]
    return np.dot(U, V_window.T)
