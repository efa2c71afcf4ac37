"""The operator of the scan: what a perturber at a position does to any fit, built once per lens.

Symbols are those of docs/scan.md. Its Delta R at one position without nested shapelets,

    J_pert - J_smooth = -2 t.delta + delta.S delta - q.H q,

is by the Woodbury identity one symmetric form in v = [delta; t],

    J_pert - J_smooth = v.M v,    M = [[Y^T Y, -(I + Y^T G_E)], [-(I + G_E^T Y), G_E^T G_E - S]]^-1,

which is built from sums without cancellation and needs the convolved pixels U = W P E only through
S = U^T U, whose elements are read from a table made by convolution (`BandProjection.overlap`).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit
from scipy import linalg

from warmlens.fitting.linear import LinearModel
from warmlens.imaging.psf import Convolution
from warmlens.imaging.shapelets import ShapeletSet
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.perturber import PerturbedBasis, Perturber, basis_change, moved_pixels, perturbed_basis
from warmlens.types import FloatArray, IntArray

_BLOCK_ROWS = 1024  # moved pixels whose Y is computed in one triangular product
_BLOCK_COLUMNS = 128


@dataclass(frozen=True)
class BandProjection:
    """What all positions of one band share.

    Attributes
    ----------
    projected
        G^T [npix, n], G = L^-1 A^T W P.
    overlap
        S by pixel and offset [span + 1, 2 span + 1, npix]: element [dy, dx + span, i] is u_i.u_j for the
        pixel j that lies dy rows and dx columns after i, u_i = W P e_i. The span is the largest offset
        within one perturber's reach.
    n_columns
        Image columns nx, which turns a flat pixel into its row and column.
    """

    projected: FloatArray
    overlap: FloatArray
    n_columns: int


@dataclass(frozen=True)
class OperatorShard:
    """Operator of a run of positions for one band, as flat arrays.

    Attributes
    ----------
    positions
        Perturber positions (x, y) [arcsec], [n_positions, 2].
    pixel_offsets, pixels
        Pixels moved at position p: pixels[pixel_offsets[p] : pixel_offsets[p + 1]], m of them, ascending.
    matrix_offsets, matrices
        M of position p: the lower triangle, row by row, of a symmetric [2m, 2m] matrix,
        matrices[matrix_offsets[p] : matrix_offsets[p + 1]], m(2m + 1) numbers.
    """

    positions: FloatArray
    pixel_offsets: IntArray
    pixels: IntArray
    matrix_offsets: IntArray
    matrices: FloatArray

    @property
    def n_positions(self) -> int:
        """Number of positions."""
        return self.positions.shape[0]


def project_band(
    model: LinearModel, convolution: Convolution, weights: FloatArray, rays: SmoothRays, perturber: Perturber
) -> BandProjection:
    """Compute G and the table of S, once per band for all shards.

    Parameters
    ----------
    model, convolution, weights
        Linear model of the band and what it was built from; weights are 1/sigma [ny, nx].
    rays
        Smooth rays, of the image's pixels in row-major order.
    perturber
        Its reach fixes how far apart two moved pixels can be.
    """
    ny, nx = convolution.shape
    npix = ny * nx
    if weights.shape != (ny, nx) or model.design.shape[0] != npix or rays.theta_x.shape[0] != npix:
        raise ValueError(
            f"image is {ny} x {nx}, but weights are {weights.shape}, the design matrix {model.design.shape} "
            f"and the rays {rays.theta_x.shape}"
        )
    n = model.design.shape[1]
    flat_weights = weights.reshape(npix, 1)
    projected = np.empty((npix, n))
    for first in range(0, n, _BLOCK_COLUMNS):
        last = min(first + _BLOCK_COLUMNS, n)
        # L^-1 is lower triangular: rows up to `last` use the columns up to `last`.
        whitened = flat_weights * (model.design[:, :last] @ model.inverse_factor[first:last, :last].T)
        images = np.ascontiguousarray(whitened.T).reshape(-1, ny, nx)
        projected[:, first:last] = convolution.adjoint(images).reshape(-1, npix).T  # G^T = P^T W A L^-T
    return BandProjection(projected, _overlap_table(convolution, weights, _pixel_span(rays, nx, perturber)), nx)


def _pixel_span(rays: SmoothRays, n_columns: int, perturber: Perturber) -> int:
    """Largest row or column offset of two pixels that one perturber can move."""
    x, y = rays.theta_x.mean(axis=1), rays.theta_y.mean(axis=1)
    pixel_scale = np.hypot(x[1] - x[0], y[1] - y[0])
    diagonal = pixel_scale * np.sqrt(2.0)
    n_rows = x.size // n_columns
    span = int(np.ceil((2.0 * perturber.reach + diagonal) / pixel_scale))
    return min(span, max(n_rows, n_columns) - 1)


def _overlap_table(convolution: Convolution, weights: FloatArray, span: int) -> FloatArray:
    """S_ij = sum_p w_p^2 psf(p - i) psf(p - j) for all i and all offsets j - i within the span."""
    psf = np.pad(convolution.psf, span)
    squared = weights**2
    inner = slice(span, psf.shape[0] - span), slice(span, psf.shape[1] - span)
    table = np.empty((span + 1, 2 * span + 1, weights.size))
    for dy in range(span + 1):
        for dx in range(-span, span + 1):
            product = psf * np.roll(psf, (dy, dx), axis=(0, 1))  # psf(p) psf(p - (dy, dx)); the margin is 0
            table[dy, dx + span] = Convolution(product[inner], convolution.shape).adjoint(squared).ravel()
    return table


def build_shard(
    model: LinearModel,
    projection: BandProjection,
    weights: FloatArray,
    sets: tuple[ShapeletSet, ...],
    rays: SmoothRays,
    perturber: Perturber,
    positions: FloatArray,
) -> OperatorShard:
    """Operator of the given positions for one band.

    Parameters
    ----------
    model, projection, weights
        Linear model of the band, its `project_band`, and 1/sigma [ny, nx].
    sets
        Source basis; the model's source columns must be `pixel_basis(sets, rays.source_x, rays.source_y)`.
    rays, perturber
        Smooth rays and the perturber that is added to them.
    positions
        (x, y) [arcsec], [n_positions, 2].

    Notes
    -----
    Where a perturber moves no unmasked pixel, the position gets no pixels and Delta R is exactly 0 (also
    if the PSF would carry light from its masked pixels into unmasked ones).
    """
    basis = perturbed_basis(sets, rays, perturber)
    n_source = basis.n_coef
    if n_source != model.n_source:
        raise ValueError(
            f"the shapelet sets have {n_source} functions, the linear model {model.n_source} source columns; "
            "build both from the same smooth_model.source.n_max"
        )
    positions = np.ascontiguousarray(positions, dtype=np.float64)
    if positions.ndim != 2 or positions.shape[1] != 2 or not np.all(np.isfinite(positions)):
        raise ValueError(f"positions must be finite and [n_positions, 2], got {positions.shape}")
    pixel_offsets, pixels = moved_pixels(
        rays.theta_x, rays.theta_y, weights.ravel() > 0.0, positions, perturber.reach
    )
    moved = np.diff(pixel_offsets)
    matrix_offsets = np.concatenate([[0], np.cumsum(moved * (2 * moved + 1))])
    matrices = np.empty(matrix_offsets[-1])
    for first, last in _position_blocks(pixel_offsets):
        rows = int(pixel_offsets[last] - pixel_offsets[first])
        change = np.zeros((model.design.shape[1], rows))  # dB^T, columns that do not move included
        _fill_change(basis, positions, pixel_offsets, pixels, first, last, change)
        change[:n_source] /= model.column_norms[:n_source, None]
        # Y = L^-1 dB^T, in place: as Fortran arrays, Y^T = dB L^-T
        solved = linalg.blas.dtrmm(1.0, model.inverse_factor.T, change.T, side=1, lower=0, overwrite_b=1).T
        _fill_matrices(
            projection.projected, projection.overlap, projection.n_columns, np.ascontiguousarray(solved),
            pixel_offsets, pixels, first, last, matrix_offsets, matrices,
        )  # fmt: skip
    return OperatorShard(positions, pixel_offsets, pixels, matrix_offsets.astype(np.int64), matrices)


def _position_blocks(pixel_offsets: IntArray) -> list[tuple[int, int]]:
    """Runs [first, last) of one or more positions with about _BLOCK_ROWS moved pixels each."""
    n_blocks = int(pixel_offsets[-1]) // _BLOCK_ROWS + 1
    edges = np.searchsorted(pixel_offsets, np.linspace(0, pixel_offsets[-1], n_blocks + 1))
    edges[0], edges[-1] = 0, pixel_offsets.size - 1
    return [(int(a), int(b)) for a, b in pairwise(edges) if a < b]


@njit(cache=True)
def _fill_change(
    basis: PerturbedBasis,
    positions: FloatArray,
    pixel_offsets: IntArray,
    pixels: IntArray,
    first: int,
    last: int,
    change: FloatArray,
) -> None:
    """dB^T of the positions first..last-1, side by side, into the leading rows of `change`."""
    base = pixel_offsets[first]
    for position in range(first, last):
        start, stop = pixel_offsets[position], pixel_offsets[position + 1]
        if stop > start:
            change[: basis.n_coef, start - base : stop - base] = basis_change(
                basis, positions[position, 0], positions[position, 1], pixels[start:stop]
            )


@njit(cache=True)
def _fill_matrices(
    projected: FloatArray,
    overlap: FloatArray,
    n_columns: int,
    solved: FloatArray,
    pixel_offsets: IntArray,
    pixels: IntArray,
    first: int,
    last: int,
    matrix_offsets: IntArray,
    matrices: FloatArray,
) -> None:
    """M of the positions first..last-1; `solved` holds their Y [n, rows] side by side."""
    n = solved.shape[0]
    span = overlap.shape[0] - 1
    base = pixel_offsets[first]
    for position in range(first, last):
        start, stop = pixel_offsets[position], pixel_offsets[position + 1]
        m = stop - start
        if m == 0:
            continue
        moved = pixels[start:stop]
        Y = solved[:, start - base : stop - base].copy()  # [n, m]
        G_E = np.empty((m, n))  # transposed: a row per pixel
        for i in range(m):
            G_E[i] = projected[moved[i]]
        system = np.empty((2 * m, 2 * m))
        system[:m, :m] = np.dot(Y.T, Y)
        system[m:, :m] = -np.dot(G_E, Y)
        system[m:, m:] = np.dot(G_E, G_E.T)
        for i in range(m):
            system[m + i, i] -= 1.0
            for j in range(i, m):  # ascending pixels: j is in the same row as i or in a later one
                dy = moved[j] // n_columns - moved[i] // n_columns
                dx = moved[j] % n_columns - moved[i] % n_columns
                S_ij = overlap[dy, dx + span, moved[i]]
                system[m + j, m + i] -= S_ij
                if j > i:
                    system[m + i, m + j] -= S_ij
        system[:m, m:] = system[m:, :m].T
        M = np.linalg.inv(system)
        k = matrix_offsets[position]
        for i in range(2 * m):
            for j in range(i + 1):
                matrices[k] = 0.5 * (M[i, j] + M[j, i])
                k += 1
