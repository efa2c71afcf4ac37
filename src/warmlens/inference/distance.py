"""Distances D between the summaries of two scans, and points whose squared Euclidean distance is D."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.distance import cdist

from warmlens.types import FloatArray


def correlation_distance(dr_arcsec: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Integrate (C1 - C2)^2 over dr, from 0 to the last bin (2.5" by default), by the trapezoid rule: d1.

    C(dr) are [..., n_dr] at ascending `dr_arcsec` [n_dr]; leading axes broadcast. The distance has units of
    Delta R^4 arcsec. abc.csv reports it; the acceptance cuts on the same D, equal up to rounding, between the
    points of `integral_features`.

    Reference: Birrer+2017, eq. of D(C1, C2) in sec. 4.2.
    """
    return _integrated_squared_difference("correlation function", dr_arcsec, first, second)


def cumulative_distance(thresholds: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Integrate (N1 - N2)^2 over the thresholds in Delta R by the trapezoid rule: d2.

    N(< Delta R) are [..., n_thresholds] at ascending `thresholds`; leading axes broadcast. abc.csv reports it;
    the acceptance cuts on the same D, equal up to rounding, between the points of `integral_features`.

    Reference: the paper uses the cumulative distribution without defining its distance; to take the form of
    d1 is this project's choice.
    """
    return _integrated_squared_difference("cumulative distribution", thresholds, first, second)


def _integrated_squared_difference(
    name: str, grid: FloatArray, first: FloatArray, second: FloatArray
) -> FloatArray:
    """Integrate (first - second)^2 over the last axis by the trapezoid rule."""
    if grid.ndim != 1 or grid.size < 2 or not (np.diff(grid) > 0.0).all():
        raise ValueError(f"the grid of the {name} must be 1-D, strictly ascending, with at least 2 points")
    for label, summary in (("first", first), ("second", second)):
        if summary.shape[-1] != grid.size:
            raise ValueError(f"{label} {name} has shape {summary.shape}, the grid {grid.shape}")
        if not np.isfinite(summary).all():
            raise ValueError(
                f"{label} {name} is not finite in {int((~np.isfinite(summary)).sum())} places; leave failed "
                "samples out of the table"
            )
    return np.asarray(np.trapezoid((first - second) ** 2, grid, axis=-1))  # D = int (C1 - C2)^2 d(dr)


def integral_features(grid: FloatArray, values: FloatArray) -> FloatArray:
    """Turn summaries [..., n_grid] on an ascending grid into points of the same shape, to cut on.

    The squared Euclidean distance of two points is, up to rounding, the D that `correlation_distance` and
    `cumulative_distance` compute for abc.csv: the trapezoid integral of the squared difference.
    """
    return values * np.sqrt(np.trapezoid(np.eye(grid.size), grid, axis=1))


def squared_distances(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the squared Euclidean distance [n, m] of every point of [n, p] to every point of [m, p]."""
    return cdist(first, second, "sqeuclidean")


def ledoit_wolf(rows: FloatArray) -> tuple[FloatArray, float]:
    """Return the covariance of rows [n, p] shrunk to a multiple of the unit matrix, and the shrinkage in [0, 1].

    Reference: Ledoit & Wolf 2004, J. Multivariate Anal. 88, 365, eqs. 14-15.
    """
    n, p = rows.shape
    centred = rows - rows.mean(axis=0)
    sample = centred.T @ centred / n
    mean = np.trace(sample) / p
    spread = np.square(sample - mean * np.eye(p)).sum()  # d^2 p
    if spread == 0.0:
        return sample, 1.0
    error = (np.square(np.square(centred).sum(axis=1)).sum() / n - np.square(sample).sum()) / n  # b^2 p
    shrinkage = float(np.clip(error / spread, 0.0, 1.0))
    return (1.0 - shrinkage) * sample + shrinkage * mean * np.eye(p), shrinkage


def whitening(rows: FloatArray, observed: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return the map of [..., p] to coordinates in which the Ledoit-Wolf covariance of rows [n, p] is 1.

    Columns that are the same in every row and in the observation [p] are left out. A column that differs in the
    observation only is kept, and the shrinkage sets its scale.
    """
    varying = (np.ptp(rows, axis=0) > 0.0) | (observed != rows[0])
    if not np.ptp(rows, axis=0).any():
        return lambda values: values
    rows = rows[:, varying]
    scale = rows.std(axis=0)
    scale[scale == 0.0] = scale[scale > 0.0].min()
    covariance, _ = ledoit_wolf(rows / scale)
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values, 1e-10 * values[-1])
    transform = vectors / np.sqrt(values) / scale[:, None]
    return lambda values: values[..., varying] @ transform
