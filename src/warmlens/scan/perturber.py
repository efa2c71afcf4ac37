"""The perturber of the substructure scan, and the rays and pixels that it moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from warmlens.imaging.shapelets import (
    ShapeletSet,
    add_basis,
    n_coefficients,
    pack_sets,
    recurrence_factors,
)
from warmlens.kernels import njit
from warmlens.lensing.rays import SmoothRays
from warmlens.types import BoolArray, FloatArray, IntArray

# Relative width of ties: distances that are equal on paper differ by less after rounding. Rasters and pixels are
# often commensurate, so that rays do lie at the centre of a perturber and at the edge of its reach.
ROUNDING = 1e-9
_BLOCK_ROWS = 512  # moved pixels of the positions that are computed together
_STEP = 2e-5  # of r_trunc: deflections on both sides of 0 for the derivative by the amplitude


@dataclass(frozen=True)
class Perturber:
    """Clump with the deflection of a truncated isothermal sphere (Birrer+2017, sec. 4.1)."""

    theta_e: float  # deflection inside `r_trunc` [arcsec], > 0; 0.01 in the paper
    r_trunc: float  # truncation radius [arcsec], > 0; 0.1 in the paper

    def __post_init__(self) -> None:
        for name, value in (("theta_e", self.theta_e), ("r_trunc", self.r_trunc)):
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"perturber {name} must be a positive number of arcsec, got {value!r}")

    @property
    def reach(self) -> float:
        """Radius beyond which nothing is deflected, 2 r_trunc [arcsec]."""
        return 2.0 * self.r_trunc

    def deflection(self, dx: FloatArray, dy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the deflection (x, y) [arcsec] at offsets (dx, dy) [arcsec] from the clump, any common shape.

        Radial, as for every mass, so zero by symmetry at the centre. The lens equation subtracts it.
        """
        dx, dy = np.broadcast_arrays(np.asarray(dx, dtype=np.float64), np.asarray(dy, dtype=np.float64))
        ratio = _deflection_over_radius(np.hypot(dx, dy).ravel(), self.theta_e, self.r_trunc).reshape(dx.shape)
        return ratio * dx, ratio * dy


@njit(cache=True)
def deflection_over_radius(radius: float, theta_e: float, r_trunc: float) -> float:
    """Return |alpha_clump|(r) / r, 0 at the centre to rounding; Birrer+2017, equation of sec. 4.1."""
    if radius <= ROUNDING * r_trunc or radius >= 2.0 * r_trunc:
        return 0.0
    if radius <= r_trunc:
        return theta_e / radius
    return theta_e * (2.0 - radius / r_trunc) / radius


@njit(cache=True)
def _deflection_over_radius(radius: FloatArray, theta_e: float, r_trunc: float) -> FloatArray:
    out = np.empty_like(radius)
    for i in range(radius.size):
        out[i] = deflection_over_radius(radius[i], theta_e, r_trunc)
    return out


class PerturbedBasis(NamedTuple):
    """Source basis, smooth rays and perturber as the compiled kernels want them; see `perturbed_basis`."""

    n_coef: int
    packed: FloatArray
    factors: FloatArray
    theta_x: FloatArray
    theta_y: FloatArray
    source_x: FloatArray
    source_y: FloatArray
    theta_e: float
    r_trunc: float


def perturbed_basis(sets: Sequence[ShapeletSet], rays: SmoothRays, perturber: Perturber) -> PerturbedBasis:
    """Bundle what `basis_change` needs at every position."""
    return PerturbedBasis(
        n_coefficients(sets), pack_sets(sets), recurrence_factors(sets),
        rays.theta_x, rays.theta_y, rays.source_x, rays.source_y, perturber.theta_e, perturber.r_trunc,
    )  # fmt: skip


@njit(cache=True)
def basis_change(basis: PerturbedBasis, center_x: float, center_y: float, moved: IntArray) -> FloatArray:
    """Return dB^T of docs/scan.md [n_coef, m]: basis at the perturbed rays minus basis at the smooth rays.

    `moved` are the m pixels of a perturber at (center_x, center_y).
    """
    return _difference(basis, center_x, center_y, moved, basis.theta_e, 0.0)


@njit(cache=True)
def basis_response(basis: PerturbedBasis, center_x: float, center_y: float, moved: IntArray) -> FloatArray:
    """Return dB'^T of docs/scan.md [n_coef, m]: derivative of dB^T by the amplitude, 1 for theta_e, at 0.

    A central difference over a step so small against the functions that its error is some 1e-8 of their slopes.
    """
    step = _STEP * basis.r_trunc
    return _difference(basis, center_x, center_y, moved, step, -step) * (basis.theta_e / (2.0 * step))


@njit(cache=True)
def _difference(
    basis: PerturbedBasis, center_x: float, center_y: float, moved: IntArray, upper: float, lower: float
) -> FloatArray:
    """Return the basis [n_coef, m] at rays moved by theta_e `upper` minus that at `lower`; 0: smooth rays."""
    n_sub = basis.theta_x.shape[1]
    x, y = np.empty((2 * n_sub, moved.size)), np.empty((2 * n_sub, moved.size))
    weights = np.empty(2 * n_sub)
    for sub in range(n_sub):
        weights[sub], weights[n_sub + sub] = 1.0 / n_sub, -1.0 / n_sub
    for i in range(moved.size):
        for sub in range(n_sub):
            dx, dy = basis.theta_x[moved[i], sub] - center_x, basis.theta_y[moved[i], sub] - center_y
            radius = np.sqrt(dx * dx + dy * dy)
            smooth_x, smooth_y = basis.source_x[moved[i], sub], basis.source_y[moved[i], sub]
            ratio = deflection_over_radius(radius, upper, basis.r_trunc)
            x[sub, i], y[sub, i] = smooth_x - ratio * dx, smooth_y - ratio * dy
            ratio = deflection_over_radius(radius, lower, basis.r_trunc)
            x[n_sub + sub, i], y[n_sub + sub, i] = smooth_x - ratio * dx, smooth_y - ratio * dy
    difference = np.zeros((basis.n_coef, moved.size))
    add_basis(basis.packed, basis.factors, x, y, weights, difference)
    return difference


def position_blocks(pixel_offsets: IntArray) -> list[tuple[int, int]]:
    """Divide the positions into runs [first, last) with about `_BLOCK_ROWS` moved pixels each."""
    n_blocks = int(pixel_offsets[-1]) // _BLOCK_ROWS + 1
    edges = np.searchsorted(pixel_offsets, np.linspace(0, pixel_offsets[-1], n_blocks + 1))
    edges[0], edges[-1] = 0, pixel_offsets.size - 1
    return [(int(a), int(b)) for a, b in pairwise(edges) if a < b]


@njit(cache=True)
def moved_pixels(
    theta_x: FloatArray, theta_y: FloatArray, unmasked: BoolArray, positions: FloatArray, reach: float
) -> tuple[IntArray, IntArray]:
    """Find the pixels with a sub-pixel ray that a perturber at each position moves, as CSR (offsets, pixels).

    A position whose moved pixels are all masked (or off the image) gets none. Rays at the centre and at the edge
    of the reach, to rounding, are not moved.
    """
    npix, n_sub = theta_x.shape
    center_x, center_y = np.empty(npix), np.empty(npix)
    largest = 0.0
    for pixel in range(npix):
        center_x[pixel], center_y[pixel] = theta_x[pixel].mean(), theta_y[pixel].mean()
        for sub in range(n_sub):
            dx, dy = theta_x[pixel, sub] - center_x[pixel], theta_y[pixel, sub] - center_y[pixel]
            largest = max(largest, np.sqrt(dx * dx + dy * dy))
    inner, outer = (0.5 * ROUNDING * reach) ** 2, reach * reach * (1.0 - ROUNDING)
    near = (reach + 1.001 * largest) ** 2  # beyond this no sub-pixel can be reached
    n_positions = positions.shape[0]
    offsets = np.zeros(n_positions + 1, dtype=np.int64)
    pixels = np.empty(64 * n_positions + npix, dtype=np.int64)
    for position in range(n_positions):
        start = offsets[position]
        stop = start
        if pixels.size < start + npix:
            pixels = np.concatenate((pixels, np.empty(pixels.size + npix, dtype=np.int64)))
        any_unmasked = False
        for pixel in range(npix):
            dx, dy = center_x[pixel] - positions[position, 0], center_y[pixel] - positions[position, 1]
            if dx * dx + dy * dy > near:
                continue
            for sub in range(n_sub):
                dx = theta_x[pixel, sub] - positions[position, 0]
                dy = theta_y[pixel, sub] - positions[position, 1]
                if inner < dx * dx + dy * dy < outer:
                    pixels[stop] = pixel
                    stop += 1
                    any_unmasked = any_unmasked or unmasked[pixel]
                    break
        offsets[position + 1] = stop if any_unmasked else start
    return offsets, pixels[: offsets[n_positions]].copy()
