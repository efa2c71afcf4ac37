"""Cartesian shapelets: the basis in which the surface brightness of the source is written.

A set holds all functions of total order n1 + n2 <= n_max,

    B_{n1,n2}(x, y) = phi_n1((x - center_x) / beta) phi_n2((y - center_y) / beta),
    phi_n(u) = (2^n sqrt(pi) n!)^(-1/2) H_n(u) exp(-u^2 / 2)          (Refregier 2003, eq. 1),

orthonormal in u, so that the integral of B^2 over the sky is beta^2. Order of the functions and
normalisation are those of lenstronomy's SHAPELETS profile (which leaves out the factor 1/beta of
Refregier 2003, eq. 18), so coefficients can be exchanged with it: by total order, n1 falling,
(0,0), (1,0), (0,1), (2,0), (1,1), (0,2), ...  A coefficient has the unit of the surface brightness.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warmlens.kernels import njit
from warmlens.types import FloatArray

DARK_BEYOND = 8.0  # u past the turning point sqrt(2 n + 1) of phi_n where it has fallen below 1e-17


@dataclass(frozen=True)
class ShapeletSet:
    """All shapelets up to one total order about one centre in the source plane [arcsec]."""

    n_max: int  # highest total order n1 + n2, >= 0
    beta: float  # scale [arcsec], > 0
    center_x: float
    center_y: float

    def __post_init__(self) -> None:
        if self.n_max < 0:
            raise ValueError(f"smooth_model.source.n_max must be >= 0, got {self.n_max}")
        if not (math.isfinite(self.beta) and self.beta > 0.0):
            raise ValueError(
                f"smooth_model.source.beta_arcsec must be a positive number of arcsec, got {self.beta!r}"
            )
        if not (math.isfinite(self.center_x) and math.isfinite(self.center_y)):
            raise ValueError(f"shapelet centre must be finite, got ({self.center_x}, {self.center_y})")

    @property
    def n_coefficients(self) -> int:
        """Number of functions, (n_max + 1)(n_max + 2) / 2."""
        return (self.n_max + 1) * (self.n_max + 2) // 2

    def orders(self) -> tuple[tuple[int, int], ...]:
        """Return the pairs (n1, n2) in the order of the coefficients."""
        return tuple((total - n2, n2) for total in range(self.n_max + 1) for n2 in range(total + 1))


def n_coefficients(sets: Sequence[ShapeletSet]) -> int:
    """Return the number of coefficients of several sets together."""
    return sum(shapelets.n_coefficients for shapelets in sets)


def pack_sets(sets: Sequence[ShapeletSet]) -> FloatArray:
    """Return rows (n_max, beta, center_x, center_y) [n_set, 4] for the compiled kernels."""
    if not sets:
        raise ValueError("the source needs at least one shapelet set, got none")
    return np.array([(s.n_max, s.beta, s.center_x, s.center_y) for s in sets], dtype=np.float64)


def recurrence_factors(sets: Sequence[ShapeletSet]) -> FloatArray:
    """Return the factors sqrt(2/(n+1)), sqrt(n/(n+1)) of the recurrence of phi_n [2, largest n_max + 1]."""
    n = np.arange(max(shapelets.n_max for shapelets in sets) + 1, dtype=np.float64)
    return np.stack([np.sqrt(2.0 / (n + 1.0)), np.sqrt(n / (n + 1.0))])


def basis(sets: Sequence[ShapeletSet], x: FloatArray, y: FloatArray) -> FloatArray:
    """Return every function of every set [n_ray, n_coef] at source-plane positions [n_ray] [arcsec]."""
    x, y = _same_shape(x, y, 1)
    return pixel_basis(sets, x[:, None], y[:, None])


def pixel_basis(sets: Sequence[ShapeletSet], source_x: FloatArray, source_y: FloatArray) -> FloatArray:
    """Return every function averaged over each pixel, the columns B [npix, n_coef] of the design matrix.

    The source-plane positions of the sub-pixels' rays are [npix, s2] [arcsec]; the sets follow one another. The
    columns are not scaled, so a coefficient has the unit of the image (e-/s per pixel).
    """
    source_x, source_y = _same_shape(source_x, source_y, 2)
    return _pixel_basis(pack_sets(sets), recurrence_factors(sets), source_x, source_y, n_coefficients(sets))


def surface_brightness(
    sets: Sequence[ShapeletSet], coefficients: FloatArray, x: FloatArray, y: FloatArray
) -> FloatArray:
    """Return the surface brightness at source-plane positions [arcsec], any shape, without the basis matrix.

    The coefficients [n_coef] are in the order of `basis`; the result has their unit.
    """
    coefficients = np.ascontiguousarray(coefficients, dtype=np.float64)
    if coefficients.shape != (n_coefficients(sets),):
        raise ValueError(
            f"the shapelet sets have {n_coefficients(sets)} coefficients, got shape {coefficients.shape}"
        )
    shape = np.shape(x)
    x, y = _same_shape(np.ravel(x), np.ravel(y), 1)
    return _sum_brightness(pack_sets(sets), recurrence_factors(sets), coefficients, x, y).reshape(shape)


def _same_shape(x: FloatArray, y: FloatArray, ndim: int) -> tuple[FloatArray, FloatArray]:
    x, y = np.ascontiguousarray(x, dtype=np.float64), np.ascontiguousarray(y, dtype=np.float64)
    if x.ndim != ndim or x.shape != y.shape:
        raise ValueError(f"ray positions must share a {ndim}-d shape, got x {x.shape} and y {y.shape}")
    return x, y


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _hermite_functions(u: FloatArray, factors: FloatArray, out: FloatArray) -> None:
    """Write phi_n(u) into out [n, ray], by the recurrence that is stable upwards in n."""
    for ray in range(u.size):
        out[0, ray] = math.pi**-0.25 * math.exp(-0.5 * u[ray] * u[ray])
    if out.shape[0] > 1:
        for ray in range(u.size):  # loops, not slices: numba compiles those for seconds, in every caller again
            out[1, ray] = math.sqrt(2.0) * u[ray] * out[0, ray]
    for n in range(1, out.shape[0] - 1):
        up, down = factors[0, n], factors[1, n]
        for ray in range(u.size):
            # phi_(n+1) = u sqrt(2/(n+1)) phi_n - sqrt(n/(n+1)) phi_(n-1)
            out[n + 1, ray] = up * u[ray] * out[n, ray] - down * out[n - 1, ray]


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def add_basis(
    packed: FloatArray,
    factors: FloatArray,
    x: FloatArray,
    y: FloatArray,
    weights: FloatArray,
    out: FloatArray,
) -> None:
    """Add the weighted sum over rays of every function at (x, y) to out [n_coef, npix]; for compiled callers.

    x, y are [n_ray, npix] (pixel fastest, so that every loop below is a vector operation), weights [n_ray].
    """
    n_ray, npix = x.shape
    coefficient = 0
    for k in range(packed.shape[0]):
        n_max = int(packed[k, 0])
        phi_x = np.empty((n_ray, n_max + 1, npix))
        phi_y = np.empty((n_ray, n_max + 1, npix))
        for ray in range(n_ray):
            _hermite_functions((x[ray] - packed[k, 2]) / packed[k, 1], factors, phi_x[ray])
            _hermite_functions((y[ray] - packed[k, 3]) / packed[k, 1], factors, phi_y[ray])
            for n in range(n_max + 1):
                for i in range(npix):
                    phi_x[ray, n, i] *= weights[ray]
        by_four = n_ray - n_ray % 4
        for total in range(n_max + 1):
            for n2 in range(total + 1):
                n1 = total - n2
                row = out[coefficient]
                for ray in range(0, by_four, 4):  # four rays per pass: `row` is loaded and stored once
                    x0, y0 = phi_x[ray, n1], phi_y[ray, n2]
                    x1, y1 = phi_x[ray + 1, n1], phi_y[ray + 1, n2]
                    x2, y2 = phi_x[ray + 2, n1], phi_y[ray + 2, n2]
                    x3, y3 = phi_x[ray + 3, n1], phi_y[ray + 3, n2]
                    for i in range(npix):
                        row[i] += x0[i] * y0[i] + x1[i] * y1[i] + x2[i] * y2[i] + x3[i] * y3[i]
                for ray in range(by_four, n_ray):
                    x0, y0 = phi_x[ray, n1], phi_y[ray, n2]
                    for i in range(npix):
                        row[i] += x0[i] * y0[i]
                coefficient += 1


@njit(cache=True)
def _pixel_basis(
    packed: FloatArray, factors: FloatArray, source_x: FloatArray, source_y: FloatArray, n_coef: int
) -> FloatArray:
    npix, n_sub = source_x.shape
    out = np.empty((npix, n_coef))
    weights = np.full(n_sub, 1.0 / n_sub)
    for first in range(0, npix, 64):
        last = min(first + 64, npix)
        block = np.zeros((n_coef, last - first))
        x = np.ascontiguousarray(source_x[first:last].T)
        y = np.ascontiguousarray(source_y[first:last].T)
        add_basis(packed, factors, x, y, weights, block)
        for i in range(first, last):
            for coefficient in range(n_coef):
                out[i, coefficient] = block[coefficient, i - first]
    return out


@njit(cache=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def _sum_brightness(
    packed: FloatArray, factors: FloatArray, coefficients: FloatArray, x: FloatArray, y: FloatArray
) -> FloatArray:
    out = np.zeros(x.size)
    near = np.empty(x.size, dtype=np.int64)
    start = 0
    for k in range(packed.shape[0]):
        n_max = int(packed[k, 0])
        table = np.zeros((n_max + 1, n_max + 1))  # coefficients as [n1, n2]
        for total in range(n_max + 1):
            for n2 in range(total + 1):
                table[total - n2, n2] = coefficients[start]
                start += 1
        reach = packed[k, 1] * (math.sqrt(2.0 * n_max + 1.0) + DARK_BEYOND)
        n_near = 0
        for ray in range(x.size):  # a clump is seen by few rays: the others are left out
            near[n_near] = ray
            far = (abs(x[ray] - packed[k, 2]) >= reach) | (abs(y[ray] - packed[k, 3]) >= reach)
            n_near += not far  # written so that NaN is near, and comes out as NaN
        for first in range(0, n_near, 64):
            rays = near[first : min(first + 64, n_near)]
            phi_x = np.empty((n_max + 1, rays.size))
            phi_y = np.empty((n_max + 1, rays.size))
            _hermite_functions((x[rays] - packed[k, 2]) / packed[k, 1], factors, phi_x)
            _hermite_functions((y[rays] - packed[k, 3]) / packed[k, 1], factors, phi_y)
            # sum over n1 of phi_n1(x) [sum over n2 of c_(n1,n2) phi_n2(y)]
            inner = np.dot(table, phi_y)
            light = np.zeros(rays.size)
            for n1 in range(n_max + 1):
                for i in range(rays.size):
                    light[i] += phi_x[n1, i] * inner[n1, i]
            for i in range(rays.size):
                out[rays[i]] += light[i]
    return out
