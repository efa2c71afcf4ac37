"""Check that the observation is like the simulations, and the accepted samples like the observation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warmlens.inference.memory import row_batches
from warmlens.inference.table import Table
from warmlens.types import BoolArray, FloatArray

MAX_PERCENTILE = 95.0
BATCH = 500
MAX_ROWS = 3000
PREDICTIVE_LEVELS = (0.025, 0.16, 0.5, 0.84, 0.975)


@dataclass(frozen=True)
class CloudCheck:
    """Rank of the observation's distance to its nearest sample among the same distances of the samples."""

    # Per kind of summary: percentage of samples whose nearest other sample is closer, ties counted half
    percentile: dict[str, float]
    outside: tuple[str, ...]  # a sentence for each kind above `MAX_PERCENTILE`
    uninformative: tuple[str, ...]  # and for each kind that cannot distinguish samples
    nearest: FloatArray  # distance of samples to their nearest other one [n_kinds, n_samples]

    def percentiles(self, distances: FloatArray) -> FloatArray:
        """Return the percentage of samples whose nearest other one is closer than `distances` [n_kinds, n]."""
        others = self.nearest[:, None]
        closer, tied = (others < distances[..., None]), (others == distances[..., None])
        return 100.0 * (closer.mean(axis=-1) + 0.5 * tied.mean(axis=-1))


def cloud_check(table: Table) -> CloudCheck:
    """Compare the observation's nearest-neighbour distance with those of up to `MAX_ROWS` samples."""
    chosen = np.unique(np.linspace(0, table.n - 1, min(table.n, MAX_ROWS)).astype(np.int64))
    batches = []
    for batch in row_batches(chosen.size, table.n, BATCH):
        rows = chosen[batch]
        between = table.distances_between(rows)
        between[:, np.arange(rows.size), rows] = np.inf
        batches.append(between.min(axis=2))
    nearest = np.concatenate(batches, axis=1)
    distances = table.distances()
    check = CloudCheck({}, (), (), nearest)
    values = check.percentiles(distances.min(axis=1, keepdims=True))[:, 0]
    percentile = dict(zip(table.kinds, map(float, values), strict=True))
    outside, uninformative = [], []
    for (name, value), of_kind in zip(percentile.items(), distances, strict=True):
        if value > MAX_PERCENTILE:
            outside.append(
                f"THE OBSERVATION LIES OUTSIDE THE SIMULATIONS in {name}: it is farther from its nearest sample "
                f"than {value:.1f}% of the samples are from theirs; no bound from this table can be trusted"
            )
        if np.ptp(of_kind) == 0.0:
            uninformative.append(f"all samples have the same distance in {name}: it tells nothing about them")
    return CloudCheck(percentile, tuple(outside), tuple(uninformative), nearest)


@dataclass(frozen=True)
class Rank:
    """Rank of one number among `n` others.

    `rank` is the fraction of the others below it, ties counted half. `p_value` is two-sided: the probability
    that one more of the others lies as far out, from 2 / (n + 1) to 1.
    """

    observed: float
    rank: float
    p_value: float
    n: int


def rank_among(values: FloatArray, observed: float) -> Rank:
    """Return the rank of `observed` among values [n]."""
    n = values.size
    below, tied = int((values < observed).sum()), int((values == observed).sum())
    tail = min(below, n - below - tied) + tied
    return Rank(float(observed), (below + 0.5 * tied) / n, min(1.0, 2.0 * (1 + tail) / (n + 1)), n)


@dataclass(frozen=True)
class Predictive:
    """Quantiles of the accepted samples' summary [n_levels, n_points] and the observed one [n_points].

    `p_value` is the fraction of the accepted samples whose mean distance from the other accepted ones exceeds
    that of the observation: small if the observation lies apart from all of them.
    """

    levels: FloatArray
    quantiles: FloatArray
    observed: FloatArray
    p_value: float


def posterior_predictive(values: FloatArray, observed: FloatArray, accepted: BoolArray) -> Predictive:
    """Compare one summary of the accepted of all samples [n, n_points] with the observed one [n_points]."""
    chosen = values[accepted]
    levels = np.array(PREDICTIVE_LEVELS)
    scale = chosen.std(axis=0)
    used = (scale > 0.0) | (observed != chosen[0])
    scale = np.where(scale > 0.0, scale, 1.0)
    centre = chosen.mean(axis=0)
    k = len(chosen)
    # a sample against the mean of the other k - 1
    own = np.square(((chosen - centre) * k / max(k - 1, 1) / scale)[:, used]).sum(axis=1)
    seen = np.square(((observed - centre) / scale)[used]).sum()
    p_value = float((1 + (own >= seen).sum()) / (k + 1))
    return Predictive(levels, np.quantile(chosen, levels, axis=0), observed, p_value)
