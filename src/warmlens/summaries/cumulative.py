"""Cumulative distribution of the excess residuals of a scan."""

from __future__ import annotations

import numpy as np

from warmlens.types import BoolArray, FloatArray, IntArray

DEEPEST = -40.0
SHALLOWEST = -4.0  # Birrer+2017 sec. 4.2 uses Delta R < -4 only
N_THRESHOLDS = 73


def threshold_grid(
    deepest: float = DEEPEST, shallowest: float = SHALLOWEST, n_thresholds: int = N_THRESHOLDS
) -> FloatArray:
    """Return evenly spaced thresholds in Delta R, ascending [n_thresholds]; by default -40 to -4 in steps of 0.5.

    Choice: the paper gives no grid. Anomalies deeper than the deepest threshold still count at every one.
    """
    if not (deepest < shallowest <= 0.0 and n_thresholds >= 2):
        raise ValueError(
            "need deepest < shallowest <= 0 and at least 2 thresholds, "
            f"got {deepest!r}, {shallowest!r}, {n_thresholds!r}"
        )
    return np.linspace(deepest, shallowest, n_thresholds)


def counts_below(delta_r: FloatArray, valid: BoolArray, thresholds: FloatArray) -> IntArray:
    """Count the valid positions [ny, nx] with Delta R [..., ny, nx] below each ascending threshold.

    Returns [..., n_thresholds]. The value of Delta R where a position is not valid is ignored.
    """
    if delta_r.shape[-2:] != valid.shape:
        raise ValueError(f"delta_r has shape {delta_r.shape}, the raster {valid.shape}")
    if thresholds.ndim != 1 or thresholds.size == 0 or not (np.diff(thresholds) > 0.0).all():
        raise ValueError("thresholds must be a strictly ascending 1-D array")
    values = delta_r[..., valid]
    if not np.isfinite(values).all():
        raise ValueError("delta_r is not finite at a valid position")
    lead, n_bins = values.shape[:-1], thresholds.size + 1
    values = values.reshape(-1, values.shape[-1])
    first_above = np.searchsorted(thresholds, values, side="right")  # first threshold that exceeds the value
    flat = first_above + n_bins * np.arange(values.shape[0])[:, None]
    histogram = np.bincount(flat.ravel(), minlength=n_bins * values.shape[0]).reshape(-1, n_bins)
    return np.cumsum(histogram, axis=1)[:, :-1].reshape(*lead, thresholds.size)


def cumulative_distribution(delta_r: FloatArray, valid: BoolArray, thresholds: FloatArray) -> FloatArray:
    """Return N(< Delta R), the fraction of valid positions below each threshold, [..., n_thresholds].

    Reference: Birrer+2017 sec. 5 names the cumulative distribution and does not define it; this one, over
    Delta R < -4, is this project's choice.
    """
    if not valid.any():
        raise ValueError("no position is valid")
    return counts_below(delta_r, valid, thresholds) / valid.sum()
