"""Nested source shapelets: a few more functions at the source point of each position, in both fits.

Birrer+2017 sec. 4.1 gives the source extra freedom where the perturber acts, so that Delta R is not what
a slightly too coarse source basis gains from bent rays. This module says where a position's source point lies, how
large its shapelets are and on which rays they count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warmlens.imaging.shapelets import ShapeletSet, add_basis
from warmlens.kernels import njit
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.perturber import ROUNDING, PerturbedBasis, Perturber, perturbed_basis
from warmlens.types import FloatArray, IntArray

_BLOCK_PIXELS = 64


@dataclass(frozen=True)
class NestedShapelets:
    """Freedom of the source at each position.

    Attributes
    ----------
    n_max
        Highest order, >= 0; 5 in the paper: 21 functions.
    ridge
        Weight of their Gaussian prior, > 0, in units of the largest squared norm of the position's whitened
        columns; small against 1.
    beta_range
        Smallest and largest scale [arcsec].
    """

    n_max: int
    ridge: float
    beta_range: tuple[float, float]

    def __post_init__(self) -> None:
        if self.n_max < 0:
            raise ValueError(f"scan.nested.n_max must be >= 0, got {self.n_max}; scan.nested: null for none")
        if not (math.isfinite(self.ridge) and self.ridge > 0.0):
            raise ValueError(f"scan.nested.ridge must be a positive number, got {self.ridge!r}")
        low, high = self.beta_range
        if not (0.0 < low <= high < math.inf):
            raise ValueError(
                f"scan.nested.beta_range_arcsec must be two rising numbers > 0, got {self.beta_range}"
            )


def nested_points(
    nested: NestedShapelets, rays: SmoothRays, n_columns: int, perturber: Perturber, positions: FloatArray
) -> FloatArray:
    """Return centre and scale (source x, source y, beta) [arcsec] of nested shapelets, [n_positions, 3].

    The scale is the truncation radius as the source sees it, beta = r_trunc / sqrt(mu) (Birrer+2017 sec. 4.1 sets
    it by the average magnification within the perturber), clipped to `beta_range`. The average is one of
    areas: sky within r_trunc over the source area that the mesh of pixel centres maps it to, folds counted with
    their sheets. It stays finite on a critical curve, where the average of |mu| over the sky depends on the mesh.
    The centre is where the same mesh maps the position, linear between pixel centres.

    Parameters
    ----------
    nested, perturber
        Settings.
    rays, n_columns
        Smooth rays of an image of at least 2 x 2 pixels, and its number of columns nx.
    positions
        (x, y) on the sky [arcsec], [n_positions, 2].
    """
    npix = rays.theta_x.shape[0]
    n_rows = npix // n_columns
    if n_rows < 2 or n_columns < 2 or n_rows * n_columns != npix:
        raise ValueError(f"nested shapelets need an image of 2 x 2 pixels, got {npix} in {n_columns} columns")
    x, y = rays.theta_x.mean(axis=1), rays.theta_y.mean(axis=1)
    step = np.array([[x[1] - x[0], x[n_columns] - x[0]], [y[1] - y[0], y[n_columns] - y[0]]])
    in_pixels = np.linalg.solve(step, (positions - (x[0], y[0])).T).T  # (column, row)
    source = np.stack([rays.source_x.mean(axis=1), rays.source_y.mean(axis=1)], axis=1)
    points = _source_points(source.reshape(n_rows, n_columns, 2), in_pixels, step, perturber.r_trunc)
    points[:, 2] = np.clip(perturber.r_trunc * np.sqrt(points[:, 2]), *nested.beta_range)
    return points


@njit(cache=True)
def _source_points(source: FloatArray, in_pixels: FloatArray, step: FloatArray, radius: float) -> FloatArray:
    """Return source position and mean 1/|mu| within the radius of each position [n_positions, 3]."""
    n_rows, n_columns = source.shape[:2]
    area = abs(step[0, 0] * step[1, 1] - step[0, 1] * step[1, 0])
    reach = math.ceil(radius / math.sqrt(area)) + 1
    out = np.empty((in_pixels.shape[0], 3))
    for position in range(in_pixels.shape[0]):
        column, row = in_pixels[position]
        left = min(max(math.floor(column), 0), n_columns - 2)
        low = min(max(math.floor(row), 0), n_rows - 2)
        u, v = column - left, row - low  # beyond [0, 1] off the image: its outermost mesh goes on
        for axis in range(2):
            out[position, axis] = (1.0 - v) * (
                (1.0 - u) * source[low, left, axis] + u * source[low, left + 1, axis]
            ) + v * ((1.0 - u) * source[low + 1, left, axis] + u * source[low + 1, left + 1, axis])
        rows = range(max(low - reach, 0), min(low + reach, n_rows - 2) + 1)
        columns = range(max(left - reach, 0), min(left + reach, n_columns - 2) + 1)
        nearest = math.inf
        for r in rows:
            for c in columns:
                nearest = min(nearest, _squared_distance(step, c + 0.5 - column, r + 0.5 - row))
        within = max(radius * radius, nearest) * (1.0 + ROUNDING)  # a small radius holds no centre of a cell
        total, count = 0.0, 0
        for r in rows:
            for c in columns:
                if _squared_distance(step, c + 0.5 - column, r + 0.5 - row) <= within:
                    total += _source_area(source, r, c)
                    count += 1
        out[position, 2] = total / (count * area)
    return out


@njit(cache=True)
def _squared_distance(step: FloatArray, columns: float, rows: float) -> float:
    dx, dy = step[0, 0] * columns + step[0, 1] * rows, step[1, 0] * columns + step[1, 1] * rows
    return dx * dx + dy * dy


@njit(cache=True)
def _source_area(source: FloatArray, row: int, column: int) -> float:
    """Return the area that the mesh cell between four pixel centres maps to.

    The cell is cut into two triangles along either diagonal, and the mean of both taken: one alone would make the
    area depend on the handedness of the detector.
    """
    a, b = source[row, column], source[row, column + 1]
    c, d = source[row + 1, column], source[row + 1, column + 1]
    return 0.5 * (_triangle(a, b, c) + _triangle(d, b, c) + _triangle(b, a, d) + _triangle(c, a, d))


@njit(cache=True)
def _triangle(a: FloatArray, b: FloatArray, c: FloatArray) -> float:
    return 0.5 * abs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def nested_basis(n_max: int, rays: SmoothRays, perturber: Perturber) -> PerturbedBasis:
    """Bundle shapelets up to n_max for `at_point`; no function at all if n_max is negative."""
    basis = perturbed_basis((ShapeletSet(max(n_max, 0), 1.0, 0.0, 0.0),), rays, perturber)
    return basis if n_max >= 0 else basis._replace(n_coef=0)


@njit(cache=True)
def at_point(nested: PerturbedBasis, point: FloatArray) -> PerturbedBasis:
    """Move the nested shapelets to (source x, source y, beta)."""
    packed = nested.packed.copy()
    packed[0, 1], packed[0, 2], packed[0, 3] = point[2], point[0], point[1]
    return PerturbedBasis(
        nested.n_coef, packed, nested.factors, nested.theta_x, nested.theta_y, nested.source_x, nested.source_y,
        nested.theta_e, nested.r_trunc,
    )  # fmt: skip


@njit(cache=True)
def nested_columns(nested: PerturbedBasis, point: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return N_s^T of docs/scan.md where it matters: ascending pixels [n_seen], functions [n_coef, n_seen]."""
    basis = at_point(nested, point)
    pixels = _seen_from(basis, point)
    n_sub = basis.source_x.shape[1]
    columns = np.empty((basis.n_coef, pixels.size))
    weights = np.full(n_sub, 1.0 / n_sub)
    for first in range(0, pixels.size, _BLOCK_PIXELS):
        last = min(first + _BLOCK_PIXELS, pixels.size)
        x, y = np.empty((n_sub, last - first)), np.empty((n_sub, last - first))
        for i in range(first, last):
            for sub in range(n_sub):
                x[sub, i - first] = basis.source_x[pixels[i], sub]
                y[sub, i - first] = basis.source_y[pixels[i], sub]
        block = np.zeros((basis.n_coef, last - first))
        add_basis(basis.packed, basis.factors, x, y, weights, block)
        for coefficient in range(basis.n_coef):
            for i in range(first, last):
                columns[coefficient, i] = block[coefficient, i - first]
    return pixels, columns


@njit(cache=True)
def _seen_from(nested: PerturbedBasis, point: FloatArray) -> IntArray:
    """Return pixels with a ray near (source x, source y) in units of the scale, ascending.

    All images of the source point count, not only the one that is perturbed. A function of order n has fallen
    below 1e-8 of its maximum 4.5 scales beyond its turning point sqrt(2n + 1); pixels without a sub-pixel
    within that are left out.
    """
    reach = (point[2] * (math.sqrt(2.0 * nested.packed[0, 0] + 1.0) + 4.5)) ** 2
    npix, n_sub = nested.source_x.shape
    pixels = np.empty(npix, dtype=np.int64)
    count = 0
    for pixel in range(npix):
        for sub in range(n_sub):
            dx, dy = nested.source_x[pixel, sub] - point[0], nested.source_y[pixel, sub] - point[1]
            if dx * dx + dy * dy < reach:
                pixels[count] = pixel
                count += 1
                break
    return pixels[:count].copy()


@njit(cache=True)
def nested_block(nested: PerturbedBasis, points: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return N_s^T of several points one below the other, on all pixels that see one of them.

    These are ascending pixels [n_seen] and functions [n_points * n_coef, n_seen], 0 where `nested_columns` leaves
    pixels out. Neighbouring positions see nearly the same pixels: one product with a dense matrix is faster than
    one for each.
    """
    if nested.n_coef == 0:
        return np.empty(0, dtype=np.int64), np.empty((0, 0))
    rows = np.full(nested.source_x.shape[0], -1, dtype=np.int64)
    for i in range(points.shape[0]):
        for pixel in _seen_from(nested, points[i]):
            rows[pixel] = 0
    seen = np.flatnonzero(rows == 0)
    for row in range(seen.size):
        rows[seen[row]] = row
    columns = np.zeros((points.shape[0] * nested.n_coef, seen.size))
    for i in range(points.shape[0]):
        pixels, part = nested_columns(nested, points[i])
        for coefficient in range(nested.n_coef):
            for k in range(pixels.size):
                columns[i * nested.n_coef + coefficient, rows[pixels[k]]] = part[coefficient, k]
    return seen, columns
