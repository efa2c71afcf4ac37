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

from warmlens.imaging.psf import Convolution
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.forms import Optics, Pieces, fill_change, fill_forms
from warmlens.scan.nested import NestedShapelets, nested_basis, nested_block, nested_points
from warmlens.scan.perturber import PerturbedBasis, Perturber, moved_pixels, position_blocks
from warmlens.scan.shard import OperatorShard, ScanBand, n_functions, response_offsets, stack_rows
from warmlens.types import FloatArray

_BLOCK_COLUMNS = 128


@dataclass(frozen=True)
class BandProjection:
    """What all positions of one band share (arrays of the design artifact).

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


def project_band(band: ScanBand) -> BandProjection:
    """Compute G and the table of S, once per band for all shards."""
    ny, nx = band.convolution.shape
    npix, n = band.model.design.shape
    flat_weights = band.weights.reshape(npix, 1)
    projected = np.empty((npix, n))
    for first in range(0, n, _BLOCK_COLUMNS):
        last = min(first + _BLOCK_COLUMNS, n)
        # L^-1 is lower triangular: rows up to `last` use the columns up to `last`.
        whitened = flat_weights * (band.model.design[:, :last] @ band.model.inverse_factor[first:last, :last].T)
        images = np.ascontiguousarray(whitened.T).reshape(-1, ny, nx)
        projected[:, first:last] = band.convolution.adjoint(images).reshape(-1, npix).T  # G^T = P^T W A L^-T
    span = _pixel_span(band.rays, nx, band.perturber)
    return BandProjection(projected, _overlap_table(band.convolution, band.weights, span), nx)


def _pixel_span(rays: SmoothRays, n_columns: int, perturber: Perturber) -> int:
    """Return the largest row or column offset of two pixels that one perturber can move."""
    x, y = rays.theta_x.mean(axis=1), rays.theta_y.mean(axis=1)
    pixel_scale = np.hypot(x[1] - x[0], y[1] - y[0])
    diagonal = pixel_scale * np.sqrt(2.0)
    n_rows = x.size // n_columns
    span = int(np.ceil((2.0 * perturber.reach + diagonal) / pixel_scale))
    return min(span, max(n_rows, n_columns) - 1)


def _overlap_table(convolution: Convolution, weights: FloatArray, span: int) -> FloatArray:
    """Return S_ij = sum_p w_p^2 psf(p - i) psf(p - j) for all i and all offsets j - i within the span."""
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
    band: ScanBand,
    projection: BandProjection,
    positions: FloatArray,
    nested: NestedShapelets | None = None,
    *,
    response: bool = False,
) -> OperatorShard:
    """Build the operator of the given positions for one band.

    Parameters
    ----------
    projection
        `project_band` of the band.
    positions
        (x, y) [arcsec], [n_positions, 2].
    nested
        Shapelets at each position's source point that both fits get; None for none.
    response
        Whether the linear response is wanted too.

    Raises
    ------
    ValueError
        If positions are impossible, or nested columns are degenerate to rounding.

    Notes
    -----
    Where a perturber moves no unmasked pixel, the position gets no pixels and Delta R is exactly 0 (also
    if the PSF would carry light from its masked pixels into unmasked ones).
    """
    model, weights, convolution = band.model, band.weights, band.convolution
    basis = band.basis()
    positions = np.ascontiguousarray(positions, dtype=np.float64)
    if positions.ndim != 2 or positions.shape[1] != 2 or not np.all(np.isfinite(positions)):
        raise ValueError(f"positions must be finite and [n_positions, 2], got {positions.shape}")
    shard = _empty_shard(band, positions, nested, response)
    extra = nested_basis(shard.nested_n_max, band.rays, band.perturber)
    optics = Optics(convolution.psf, weights, projection.overlap, 0.0 if nested is None else nested.ridge)
    offsets = shard.response_offsets
    sqrt_prior = np.sqrt(model.prior)

    def with_prior(rows: FloatArray) -> FloatArray:
        """Return (Lambda^1/2 L^-T Z)^T of rows Z^T."""
        return _triangular_product(model.inverse_factor, rows.copy(), transposed=True) * sqrt_prior

    for span in position_blocks(shard.pixel_offsets):
        first, last = span
        moved = shard.pixels[shard.pixel_offsets[first] : shard.pixel_offsets[last]]
        different, place = np.unique(moved, return_inverse=True)  # several positions move the same pixels
        active = np.diff(shard.pixel_offsets[first : last + 1]) > 0
        seen, columns = nested_block(extra, shard.points[first:last][active])  # N_s^T
        Y = _solve_change(band, basis, shard, span, slope=False)
        parts = Y, projection.projected[different], columns @ projection.projected[seen]
        rows, prior_rows = (  # Z^T = [Y, -G_E, -G N_s]^T
            stack_rows(shard.pixel_offsets, span, extra.n_coef, solved, -pixel_rows[place], -nested_rows)
            for solved, pixel_rows, nested_rows in (parts, map(with_prior, parts))
        )
        images = np.zeros((columns.shape[0], weights.size))
        images[:, seen] = columns
        convolved = weights * convolution.forward(images.reshape(-1, *weights.shape))  # V_s = W P N_s
        slopes = np.zeros((0, Y.shape[1]))
        if response:
            slopes = _solve_change(band, basis, shard, span, slope=True)
        shape = np.count_nonzero(active), extra.n_coef, weights.size
        pieces = Pieces(
            rows, prior_rows, slopes, with_prior(slopes), images.reshape(shape), convolved.reshape(shape)
        )
        degenerate = fill_forms(shard, offsets, span, extra, optics, pieces)
        if degenerate >= 0:
            x, y = positions[degenerate]
            raise ValueError(
                f"the nested shapelets at position ({x:.3f}, {y:.3f}) are degenerate to rounding with the source "
                f"basis at scan.nested.ridge = {optics.ridge:g}; raise it (1e-8 or above works)"
            )
    return shard


def _empty_shard(
    band: ScanBand, positions: FloatArray, nested: NestedShapelets | None, response: bool
) -> OperatorShard:
    """Find moved pixels and nested points of the positions, and allocate their forms."""
    n_positions, rays = positions.shape[0], band.rays
    nested_n_max = -1 if nested is None else nested.n_max
    n_nested = n_functions(nested_n_max)
    points = np.zeros((n_positions, 3))
    if nested is not None:
        points = nested_points(nested, rays, band.convolution.shape[1], band.perturber, positions)
    pixel_offsets, pixels = moved_pixels(
        rays.theta_x, rays.theta_y, band.weights.ravel() > 0.0, positions, band.perturber.reach
    )
    moved = np.diff(pixel_offsets)
    sizes = np.where(moved > 0, 2 * moved + n_nested, 0)
    matrix_offsets = np.concatenate([[0], np.cumsum(sizes * (sizes + 1) // 2)]).astype(np.int64)
    return OperatorShard(
        positions=positions,
        pixel_offsets=pixel_offsets,
        pixels=pixels,
        matrix_offsets=matrix_offsets,
        matrices=np.empty(matrix_offsets[-1]),
        sensitivity=np.empty(matrix_offsets[-1]),
        points=points,
        nested_inverse=np.zeros((n_positions, n_nested * (n_nested + 1) // 2)),
        nested_n_max=nested_n_max,
        responses=np.empty(response_offsets(pixel_offsets, n_nested)[-1] if response else 0),
        response_noise=np.zeros(n_positions if response else 0),
    )


def _solve_change(
    band: ScanBand, basis: PerturbedBasis, shard: OperatorShard, span: tuple[int, int], *, slope: bool
) -> FloatArray:
    """Return Y^T = dB L^-T, or Y'^T of the slope dB', of the positions of a span [moved pixels, n]."""
    model, offsets = band.model, shard.pixel_offsets
    change = np.zeros((offsets[span[1]] - offsets[span[0]], model.design.shape[1]))
    fill_change(basis, shard, span, slope, change)
    change[:, : model.n_source] /= model.column_norms[: model.n_source]  # dB, columns that do not move included
    return _triangular_product(model.inverse_factor, change, transposed=False)


def _triangular_product(inverse_factor: FloatArray, rows: FloatArray, *, transposed: bool) -> FloatArray:
    """Multiply each row of a C-ordered [k, n] by L^-1 (or L^-T), in place."""
    if not rows.size:
        return rows
    return linalg.blas.dtrmm(
        1.0, inverse_factor.T, rows.T, side=0, lower=0, trans_a=int(not transposed), overwrite_b=1
    ).T
