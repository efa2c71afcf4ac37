"""Distances between the summaries of two scans."""

from __future__ import annotations

import numpy as np

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
