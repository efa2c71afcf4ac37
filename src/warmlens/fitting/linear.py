"""The linear part of a fit of one band: coefficients of source, quasars and other fixed columns.

J(x) = |d - A x|^2 + x.Lambda x, with A = W P B (docs/scan.md), its columns scaled to unit norm, and a diagonal
Gaussian prior Lambda: a weak ridge, or what is known of a column's amplitude. A does not depend on the data, so
it is factorised once and every image after that costs matrix products.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from warmlens.imaging.psf import Convolution
from warmlens.types import FloatArray, IntArray

_BLOCK_COLUMNS = 64


@dataclass(frozen=True)
class LinearModel:
    """Whitened design matrix of one band and its factorisation."""

    design: FloatArray  # A [npix, n] = W P B, columns scaled to unit norm; rows of masked pixels are zero
    column_norms: FloatArray  # norms of the whitened columns before scaling [n]
    inverse_factor: FloatArray  # L^-1 [n, n], lower triangular, L L^T = A^T A + Lambda
    prior: FloatArray  # diagonal of Lambda [n], > 0: the weight of the Gaussian prior on each scaled coefficient
    n_source: int  # number of leading columns that a change of the deflection moves: the source


@dataclass(frozen=True)
class LinearFit:
    """Best fit of k images."""

    coefficients: FloatArray  # x of the unit-norm columns [n, k]; see `physical_coefficients`
    residual: FloatArray  # r = d - A x, in units of sigma [npix, k]
    chi2: FloatArray  # |r|^2 [k]
    penalty: FloatArray  # x.Lambda x [k]; chi2 + penalty is the minimum J


def build_linear_model(
    source_columns: FloatArray,
    fixed_columns: FloatArray,
    convolution: Convolution,
    weights: FloatArray,
    ridge: float,
    fixed_sigma: FloatArray | None = None,
) -> LinearModel:
    """Convolve, whiten, scale and factorise the columns of one band.

    Parameters
    ----------
    source_columns
        Ray-traced source basis, not convolved [npix, n_source]; `pixel_basis` unscaled if the model is to
        be scanned, since the scan evaluates the same basis again.
    fixed_columns
        Columns that are convolved already and stay where they are: quasar images, lens light, background
        [npix, n_fixed]; n_fixed may be 0.
    convolution
        PSF convolution of the band.
    weights
        1 / sigma, 0 where masked [ny, nx].
    ridge
        Prior weight (`smooth_model.ridge`), > 0; small against 1, the norm of a column.
    fixed_sigma
        Standard deviation of the Gaussian prior on the amplitude of each fixed column, as the column is
        given [n_fixed], > 0, in addition to the ridge; infinite (or None for all) where there is the ridge alone.
    """
    ny, nx = convolution.shape
    npix, n_source = source_columns.shape
    if weights.shape != (ny, nx) or npix != ny * nx or fixed_columns.shape[0] != npix:
        raise ValueError(
            f"image is {ny} x {nx}, but weights are {weights.shape}, source columns {source_columns.shape} "
            f"and fixed columns {fixed_columns.shape}"
        )
    if not np.all(np.isfinite(weights)) or np.any(weights < 0.0):
        raise ValueError("weights (1/sigma) must be finite and >= 0; give masked pixels the weight 0")
    if not (np.isfinite(ridge) and ridge > 0.0):
        raise ValueError(f"smooth_model.ridge must be a positive number, got {ridge!r}")
    n_fixed = fixed_columns.shape[1]
    sigma = np.full(n_fixed, np.inf) if fixed_sigma is None else np.asarray(fixed_sigma, dtype=np.float64)
    if sigma.shape != (n_fixed,) or not np.all(sigma > 0.0):
        raise ValueError(
            f"fixed_sigma must hold one positive number (or inf for no prior) for each of the {n_fixed} fixed "
            f"columns, got {sigma!r}"
        )

    design, column_norms = whitened_design(source_columns, fixed_columns, convolution, weights, slice(None))
    gram = design.T @ design
    prior = np.full(column_norms.size, float(ridge))
    known = np.isfinite(sigma)
    prior[n_source:][known] += 1.0 / (sigma * column_norms[n_source:])[known] ** 2  # of the scaled coefficient
    gram[np.diag_indices_from(gram)] += prior
    factor = cholesky_factor(gram, ridge)
    inverse_factor, _ = linalg.lapack.dtrtri(factor, lower=1)
    return LinearModel(design, column_norms, np.ascontiguousarray(inverse_factor), prior, n_source)


def whitened_design(
    source_columns: FloatArray,
    fixed_columns: FloatArray,
    convolution: Convolution,
    weights: FloatArray,
    rows: IntArray | slice,
) -> tuple[FloatArray, FloatArray]:
    """Return A = W P B with columns of unit norm [n_rows, n], and the norms before scaling [n].

    `rows` are the flat pixels to keep: all, or the unmasked ones; the other arguments as in `build_linear_model`.
    """
    ny, nx = convolution.shape
    npix, n_source = source_columns.shape
    flat_weights = weights.reshape(npix, 1)[rows]
    design = np.empty((flat_weights.shape[0], n_source + fixed_columns.shape[1]))
    for first in range(0, n_source, _BLOCK_COLUMNS):
        block = slice(first, min(first + _BLOCK_COLUMNS, n_source))
        images = np.ascontiguousarray(source_columns[:, block].T).reshape(-1, ny, nx)
        design[:, block] = flat_weights * convolution.forward(images).reshape(-1, npix).T[rows]
    design[:, n_source:] = flat_weights * fixed_columns[rows]
    column_norms = np.sqrt(np.einsum("pi,pi->i", design, design))
    _check_columns(column_norms, n_source)
    design /= column_norms
    return design, column_norms


def cholesky_factor(normal: FloatArray, ridge: float) -> FloatArray:
    """Return the lower Cholesky factor L of the normal matrix of unit-norm columns [n, n], which is overwritten.

    Raises
    ------
    ValueError
        If the columns are degenerate to rounding with the `ridge` that the matrix holds already.
    """
    factor, info = linalg.lapack.dpotrf(normal.T, lower=1, clean=1, overwrite_a=1)
    # The square of a pivot is what the columns before leave of a column of unit norm.
    smallest = float(np.diagonal(factor).min()) ** 2 if info == 0 else 0.0
    if smallest <= normal.shape[0] * np.finfo(np.float64).eps:
        raise ValueError(
            f"the {normal.shape[0]} columns of the linear model are degenerate to rounding with "
            f"smooth_model.ridge = {ridge:g} (smallest squared pivot {smallest:.1e}); raise it (1e-9 or above "
            "works in double precision), or lower smooth_model.source.n_max"
        )
    return factor


def _check_columns(column_norms: FloatArray, n_source: int) -> None:
    bad = np.flatnonzero(~np.isfinite(column_norms))
    if bad.size:
        raise ValueError(
            f"{bad.size} columns of the design matrix are not finite, first: "
            f"{_describe(int(bad[0]), n_source)}; check deflection, PSF and fixed columns for NaN"
        )
    # A column far below the others (Gaussian tails of a small source basis) is all rounding of the FFT.
    empty = np.flatnonzero(column_norms <= 1e-13 * column_norms.max(initial=0.0))
    if empty.size:
        raise ValueError(
            f"{empty.size} columns of the design matrix have no light on unmasked pixels, first: "
            f"{_describe(int(empty[0]), n_source)}; change smooth_model.source.n_max or "
            "smooth_model.source.beta_arcsec so that the source basis covers the arcs, leave the fixed "
            "column out, or check the mask"
        )


def _describe(column: int, n_source: int) -> str:
    return f"source column {column}" if column < n_source else f"fixed column {column - n_source}"


def solve(model: LinearModel, whitened: FloatArray) -> LinearFit:
    """Fit each whitened image d = image * weights, flattened row-major [npix, k].

    What is not among the columns has to be subtracted before.
    """
    projected = model.inverse_factor @ (model.design.T @ whitened)
    coefficients = model.inverse_factor.T @ projected  # x = (A^T A + Lambda)^-1 A^T d
    residual = whitened - model.design @ coefficients
    chi2 = np.einsum("pk,pk->k", residual, residual)
    penalty = np.einsum("n,nk,nk->k", model.prior, coefficients, coefficients)
    return LinearFit(coefficients, residual, chi2, penalty)


def physical_coefficients(model: LinearModel, coefficients: FloatArray) -> FloatArray:
    """Return coefficients [n, k] of the columns as given to `build_linear_model`, from unit-norm ones [n, k]."""
    return coefficients / model.column_norms[:, None]
