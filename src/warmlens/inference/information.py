"""Measure what a summary set is worth: information on the relic mass over the prior, and expected bound."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warmlens.inference.bound import HEADLINE_INDEX
from warmlens.inference.calibration import CDM_LIKE_KEV, LeaveOneOut
from warmlens.inference.table import Range
from warmlens.types import BoolArray, FloatArray

N_BINS = 8
N_PERMUTATIONS = 40


@dataclass(frozen=True)
class Information:
    """Worth of a summary set over `n` pseudo-observations from the prior.

    Attributes
    ----------
    gain_nats, gain_error_nats
        Mean Kullback-Leibler divergence of the posterior of m from the prior [nat], and its error: of the
        pseudo-observations, and of the one table that they share, by chance alone.
    expected_bound_kev, expected_bound_error_kev
        Median bound of truths above `CDM_LIKE_KEV`, and its error [keV]; NaN below 10 of them.
    """

    n: int
    gain_nats: float
    gain_error_nats: float
    expected_bound_kev: float
    expected_bound_error_kev: float


def divergences(m_kev: FloatArray, accepted: BoolArray, m_range_kev: Range, n_bins: int = N_BINS) -> FloatArray:
    """Return the KL divergence from the uniform prior of the accepted masses, per selection of [n_rows, n] [nat].

    Entropy of a histogram of `n_bins` equal bins with the bias correction of Miller (1955), (bins - 1) / 2k:
    without information the mean is 0, single values may be below.
    """
    edges = np.linspace(*m_range_kev, n_bins + 1)
    bins = np.clip(np.searchsorted(edges, m_kev, side="right") - 1, 0, n_bins - 1)
    selection, row = np.nonzero(accepted)
    counts = np.bincount(selection * n_bins + bins[row], minlength=len(accepted) * n_bins).reshape(-1, n_bins)
    k = counts.sum(axis=1, keepdims=True)
    p = counts / k
    entropy = -np.sum(p * np.log(np.where(p > 0.0, p, 1.0)), axis=1)
    return np.log(n_bins) - entropy - 0.5 * (n_bins - 1) / k[:, 0]


def information(
    m_kev: FloatArray, m_range_kev: Range, trials: LeaveOneOut, rng: np.random.Generator
) -> Information:
    """Return information gain and expected bound from leave-one-out trials on one table.

    Pseudo-observations accept overlapping parts of one table. The effect of its chance excesses on their mean is
    the scatter of that mean when the masses are permuted among the rows.
    """
    some = trials.accepted.any(axis=1)
    accepted = trials.accepted[some]
    gains = divergences(m_kev, accepted, m_range_kev)
    chance = [divergences(rng.permutation(m_kev), accepted, m_range_kev).mean() for _ in range(N_PERMUTATIONS)]
    gain_error = np.hypot(gains.std(ddof=1) / np.sqrt(gains.size), np.std(chance, ddof=1))
    bounds = trials.bounds[some, HEADLINE_INDEX]
    cold = bounds[trials.truth[some, 0] > CDM_LIKE_KEV]
    median = error = np.nan
    if cold.size >= 10:
        median = float(np.median(cold))
        error = float(np.median(rng.choice(cold, (500, cold.size)), axis=1).std(ddof=1))
    return Information(gains.size, float(gains.mean()), float(gain_error), median, error)
