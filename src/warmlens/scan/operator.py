"""The operator of the scan: what a perturber at a position does to any fit, built once per lens.

Symbols are those of docs/scan.md. With the nested source shapelets folded in, Delta R of a position is one
symmetric form, Delta R = w.Q w, w = [delta; t; rho_s], and |model_pert - model_smooth|^2 = (Q w).Gamma (Q w).
Both are built from sums without cancellation of large chi2's. The convolved pixels U = W P E enter through
S = U^T U, whose elements are read from a table made by convolution (`BandProjection.overlap`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from warmlens.fitting.linear import LinearModel
from warmlens.imaging.psf import Convolution
from warmlens.imaging.shapelets import ShapeletSet
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.forms import fill_change, fill_forms, stack_rows
from warmlens.scan.nested import NestedShapelets, nested_basis, nested_block, nested_points
from warmlens.scan.perturber import Perturber, moved_pixels, perturbed_basis, position_blocks
from warmlens.types import FloatArray, IntArray

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
        Q of position p: the lower triangle, row by row, of a symmetric matrix of 2m + n_nested rows,
        matrices[matrix_offsets[p] : matrix_offsets[p + 1]].
    sensitivity
        Gamma of each position, laid out like `matrices`.
    points
        Centre and scale (source x, source y, beta) [arcsec] of the nested shapelets [n_positions, 3].
    nested_inverse
        C_s^-1 of each position, lower triangle [n_positions, n_nested (n_nested + 1) / 2].
    nested_n_max
        Their highest order; -1 without nested shapelets.
    responses
        K (lower triangle) and R [2m, n_nested] of each position, one after the other, for the linear response
        (`warmlens.scan.response`); empty if it was not asked for.
    response_noise
        What noise adds to the Fisher information on the mean, f [n_positions]; empty like `responses`.
    """

    positions: FloatArray
    pixel_offsets: IntArray
    pixels: IntArray
    matrix_offsets: IntArray
    matrices: FloatArray
    sensitivity: FloatArray
    points: FloatArray
    nested_inverse: FloatArray
    nested_n_max: int
    responses: FloatArray
    response_noise: FloatArray

    @property
    def response_offsets(self) -> IntArray:
        """Where K and R of each position begin in `responses` [n_positions + 1]."""
        return _response_offsets(self.pixel_offsets, self.n_nested)

    @property
    def n_positions(self) -> int:
        """Number of positions."""
        return self.positions.shape[0]

    @property
    def n_nested(self) -> int:
        """Number of nested shapelets of a position."""
        return _n_functions(self.nested_n_max)


def _n_functions(n_max: int) -> int:
    return (n_max + 1) * (n_max + 2) // 2


def _response_offsets(pixel_offsets: IntArray, n_nested: int) -> IntArray:
    moved = np.diff(pixel_offsets)
    return np.concatenate([[0], np.cumsum(moved * (moved + 1) // 2 + 2 * moved * n_nested)]).astype(np.int64)


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
    convolution: Convolution,
    weights: FloatArray,
    sets: tuple[ShapeletSet, ...],
    rays: SmoothRays,
    perturber: Perturber,
    positions: FloatArray,
    nested: NestedShapelets | None = None,
    *,
    response: bool = False,
) -> OperatorShard:
    """Operator of the given positions for one band.

    Parameters
    ----------
    model, projection, convolution, weights
        Linear model of the band, its `project_band`, and what both were built from; weights are 1/sigma [ny, nx].
    sets
        Source basis; the model's source columns must be `pixel_basis(sets, rays.source_x, rays.source_y)`.
    rays, perturber
        Smooth rays and the perturber that is added to them.
    positions
        (x, y) [arcsec], [n_positions, 2].
    nested
        Shapelets at each position's source point that both fits get; None for none.
    response
        Whether the linear response is wanted too.

    Raises
    ------
    ValueError
        If sets and model differ, positions are impossible, or nested columns are degenerate to rounding.

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
    nested_n_max = -1 if nested is None else nested.n_max
    n_nested = _n_functions(nested_n_max)
    extra = nested_basis(nested_n_max, rays, perturber)
    points = np.zeros((positions.shape[0], 3))
    if nested is not None:
        points = nested_points(nested, rays, projection.n_columns, perturber, positions)
    pixel_offsets, pixels = moved_pixels(
        rays.theta_x, rays.theta_y, weights.ravel() > 0.0, positions, perturber.reach
    )
    moved = np.diff(pixel_offsets)
    sizes = np.where(moved > 0, 2 * moved + n_nested, 0)
    matrix_offsets = np.concatenate([[0], np.cumsum(sizes * (sizes + 1) // 2)]).astype(np.int64)
    matrices, sensitivity = np.empty(matrix_offsets[-1]), np.empty(matrix_offsets[-1])
    nested_inverse = np.zeros((positions.shape[0], n_nested * (n_nested + 1) // 2))
    response_offsets = _response_offsets(pixel_offsets, n_nested)
    responses = np.empty(response_offsets[-1] if response else 0)
    response_noise = np.zeros(positions.shape[0] if response else 0)
    sqrt_prior = np.sqrt(model.prior)

    def with_prior(rows: FloatArray) -> FloatArray:
        """(Lambda^1/2 L^-T Z)^T of rows Z^T."""
        return _triangular_product(model.inverse_factor, rows.copy(), transposed=True) * sqrt_prior

    for first, last in position_blocks(pixel_offsets):
        here = pixels[pixel_offsets[first] : pixel_offsets[last]]
        change = np.zeros((here.size, model.design.shape[1]))
        fill_change(basis, positions, pixel_offsets, pixels, first, last, False, change)
        change[:, :n_source] /= model.column_norms[:n_source]  # dB, columns that do not move included
        solved = _triangular_product(model.inverse_factor, change, transposed=False)  # Y^T = dB L^-T
        different, place = np.unique(here, return_inverse=True)  # several positions move the same pixels
        active = moved[first:last] > 0
        seen, columns = nested_block(extra, points[first:last][active])  # N_s^T
        parts = solved, projection.projected[different], columns @ projection.projected[seen]
        rows = stack_rows(pixel_offsets, first, last, n_nested, *parts, place)
        prior_rows = stack_rows(pixel_offsets, first, last, n_nested, *map(with_prior, parts), place)
        images = np.zeros((columns.shape[0], weights.size))
        images[:, seen] = columns
        convolved = weights * convolution.forward(images.reshape(-1, *weights.shape))  # V_s = W P N_s
        slopes = np.zeros((here.size if response else 0, change.shape[1]))
        if response:
            fill_change(basis, positions, pixel_offsets, pixels, first, last, True, slopes)
            slopes[:, :n_source] /= model.column_norms[:n_source]
            slopes = _triangular_product(model.inverse_factor, slopes, transposed=False)  # Y'^T = dB' L^-T
        shape = np.count_nonzero(active), n_nested, weights.size
        degenerate = fill_forms(
            extra, points, positions, 0.0 if nested is None else nested.ridge, convolution.psf, weights,
            projection.overlap, rows, prior_rows, slopes, with_prior(slopes), images.reshape(shape),
            convolved.reshape(shape), pixel_offsets, pixels, first, last, matrix_offsets, matrices, sensitivity,
            nested_inverse, response_offsets, responses, response_noise,
        )  # fmt: skip
        if degenerate >= 0:
            x, y = positions[degenerate]
            raise ValueError(
                f"the nested shapelets at position ({x:.3f}, {y:.3f}) are degenerate to rounding with the source "
                f"basis at scan.nested.ridge = {nested.ridge if nested else 0.0:g}; raise it (1e-8 or above works)"
            )
    return OperatorShard(
        positions, pixel_offsets, pixels, matrix_offsets, matrices, sensitivity, points, nested_inverse,
        nested_n_max, responses, response_noise,
    )  # fmt: skip


def _triangular_product(inverse_factor: FloatArray, rows: FloatArray, *, transposed: bool) -> FloatArray:
    """L^-1 (or L^-T) times each row of a C-ordered [k, n], in place."""
    if not rows.size:
        return rows
    return linalg.blas.dtrmm(
        1.0, inverse_factor.T, rows.T, side=0, lower=0, trans_a=int(not transposed), overwrite_b=1
    ).T
