"""What the scan works on: a band with its linear model, and the operator of a run of positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from warmlens.fitting.linear import LinearModel
from warmlens.imaging.psf import Convolution
from warmlens.imaging.shapelets import ShapeletSet, n_coefficients
from warmlens.kernels import njit
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.perturber import PerturbedBasis, Perturber, perturbed_basis
from warmlens.types import FloatArray, IntArray


@dataclass(frozen=True)
class ScanBand:
    """One band: the linear model of its smooth fit, what that was built from, and the perturber.

    Attributes
    ----------
    model
        Its source columns must be `pixel_basis(sets, rays.source_x, rays.source_y)`.
    sets, rays
        Source basis, and smooth rays of the image's pixels in row-major order.
    perturber
        What is added to the rays.
    convolution, weights
        PSF convolution, and 1/sigma [ny, nx].

    Raises
    ------
    ValueError
        If these do not belong to one image or to one source basis.
    """

    model: LinearModel
    sets: tuple[ShapeletSet, ...]
    rays: SmoothRays
    perturber: Perturber
    convolution: Convolution
    weights: FloatArray

    def __post_init__(self) -> None:
        ny, nx = self.convolution.shape
        npix, n_source = ny * nx, n_coefficients(self.sets)
        design, theta = self.model.design.shape, self.rays.theta_x.shape
        if self.weights.shape != (ny, nx) or design[0] != npix or theta[0] != npix:
            raise ValueError(
                f"image is {ny} x {nx}, but weights are {self.weights.shape}, the design matrix {design} "
                f"and the rays {theta}"
            )
        if n_source != self.model.n_source:
            raise ValueError(
                f"the shapelet sets have {n_source} functions, the linear model {self.model.n_source} source "
                "columns; build both from the same smooth_model.source.n_max"
            )

    def basis(self) -> PerturbedBasis:
        """Bundle source basis, rays and perturber for the compiled kernels."""
        return perturbed_basis(self.sets, self.rays, self.perturber)


class OperatorShard(NamedTuple):
    """Operator of a run of positions for one band, as flat arrays; compiled kernels take it as it is.

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
        Highest order of the nested shapelets; -1 without them.
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
        return response_offsets(self.pixel_offsets, n_functions(self.nested_n_max))

    @property
    def n_positions(self) -> int:
        """Number of positions."""
        return self.positions.shape[0]


@njit(cache=True)
def n_functions(n_max: int) -> int:
    """Number of shapelets up to order n_max; 0 of order -1."""
    return (n_max + 1) * (n_max + 2) // 2


def response_offsets(pixel_offsets: IntArray, n_nested: int) -> IntArray:
    """Where K and R of each position begin [n_positions + 1]."""
    moved = np.diff(pixel_offsets)
    return np.concatenate([[0], np.cumsum(moved * (moved + 1) // 2 + 2 * moved * n_nested)]).astype(np.int64)


@njit(cache=True)
def active_positions(pixel_offsets: IntArray, span: tuple[int, int], n_nested: int) -> list[tuple[int, int, int]]:
    """List each position of a span that moves m > 0 pixels, m, and the first of its 2m + n_nested rows.

    No generator: numba cannot compile one that it has in its cache into another function.
    """
    row, active = 0, []
    for position in range(span[0], span[1]):
        m = pixel_offsets[position + 1] - pixel_offsets[position]
        if m > 0:
            active.append((position, m, row))
            row += 2 * m + n_nested
    return active


@njit(cache=True)
def stack_rows(
    pixel_offsets: IntArray,
    span: tuple[int, int],
    n_nested: int,
    first: FloatArray,
    second: FloatArray,
    nested: FloatArray,
) -> FloatArray:
    """Stack m rows of `first`, m of `second`, n_nested of `nested` for each position [sum of 2m + n_nested, k].

    `first` and `second` hold one row per moved pixel of the span, `nested` n_nested per position that moves one.
    """
    base = pixel_offsets[span[0]]
    out = np.empty((2 * first.shape[0] + nested.shape[0], first.shape[1]))
    done = 0
    for position, m, row in active_positions(pixel_offsets, span, n_nested):
        start = pixel_offsets[position] - base
        for i in range(m):
            for k in range(out.shape[1]):
                out[row + i, k] = first[start + i, k]
                out[row + m + i, k] = second[start + i, k]
        for i in range(n_nested):
            for k in range(out.shape[1]):
                out[row + 2 * m + i, k] = nested[done + i, k]
        done += n_nested
    return out
