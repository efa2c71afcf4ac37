"""Distances between the summaries of two scans."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.distance import cdist

from warmlens.types import FloatArray


def correlation_distance(dr_arcsec: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """d1: integral over dr of (C1 - C2)^2, from 0 to the last bin (2.5" by default), by the trapezoid rule.

    Parameters
    ----------
    dr_arcsec
        Bin centres [arcsec], ascending [n_dr].
    first, second
        C(dr), [..., n_dr]; leading axes broadcast.

    Returns
    -------
    distance
        [...], in units of Delta R^4 arcsec.

    Reference: Birrer+2017, eq. of D(C1, C2) in sec. 4.2.
    """
    return _integrated_squared_difference("correlation function", dr_arcsec, first, second)


def cumulative_distance(thresholds: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """d2: integral over Delta R of (N1 - N2)^2 over the grid of thresholds, by the trapezoid rule.

    Parameters
    ----------
    thresholds
        Delta R, ascending [n_thresholds].
    first, second
        N(< Delta R), [..., n_thresholds]; leading axes broadcast.

    Reference: the paper uses the cumulative distribution without defining its distance; to take the form of
    d1 is this project's choice.
    """
    return _integrated_squared_difference("cumulative distribution", thresholds, first, second)


def _integrated_squared_difference(
    name: str, grid: FloatArray, first: FloatArray, second: FloatArray
) -> FloatArray:
    """Trapezoid integral of (first - second)^2 over the last axis."""
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
    """Points whose squared Euclidean distance is the integral of the squared difference by the trapezoid rule.

    Parameters
    ----------
    grid
        Ascending [n_grid].
    values
        Summaries on the grid [..., n_grid]; the result has that shape.
    """
    return values * np.sqrt(np.trapezoid(np.eye(grid.size), grid, axis=1))


def squared_distances(first: FloatArray, second: FloatArray) -> FloatArray:
    """Squared Euclidean distance of every point of [n, p] to every point of [m, p], [n, m]."""
    return cdist(first, second, "sqeuclidean")


def ledoit_wolf(rows: FloatArray) -> tuple[FloatArray, float]:
    """Covariance of rows [n, p], shrunk towards a multiple of the unit matrix; with the intensity in [0, 1].

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
    """Change of [..., p] to coordinates in which the covariance of rows [n, p], Ledoit-Wolf shrunk, is 1.

    Columns that are the same in every row and in the observation [p] carry nothing and are left out; one that
    only the observation breaks is kept, and the shrinkage sets its scale.
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
