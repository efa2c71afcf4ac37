"""Rules that accept the samples of the table closest to the observation.

max_rank
    The k = round(f n) samples with the smallest larger rank of the distances: the AND of a cut on each
    distance at one common quantile. The default.
marginal_and
    Samples below the f quantile of every distance; how many those are depends on how the distances correlate.
scaled_sum
    The k smallest sums of d_i / MAD(d_i).
correlation, cumulative
    The k smallest values of one distance alone.

Reference: Birrer+2017 sec. 5 ("reside in the best 5% of the sample" of both); docs/inference.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # scipy.stats takes 1 s to import; scipy loads it on first use

from warmlens.types import BoolArray, FloatArray, IntArray

KINDS = ("correlation", "cumulative")
JOINT_RULES = ("max_rank", "marginal_and", "scaled_sum")
RULES = (*JOINT_RULES, *KINDS)


@dataclass(frozen=True)
class Acceptance:
    """The accepted rows of a table of n samples, by one of the `RULES`."""

    accepted: BoolArray  # True for the accepted rows [n]
    max_rank: IntArray  # r_j, the largest rank of row j over the kinds of distance (1 is closest) [n]
    fraction: float  # requested fraction
    n_tied: int  # rows with the score at the cut, if only some of them are accepted; 0 otherwise
    # Common quantile of all distances below which the accepted rows lie: the largest accepted r_j / n
    implied_quantile: float
    rule: str

    @property
    def n(self) -> int:
        """Samples in the table."""
        return self.accepted.size

    @property
    def k(self) -> int:
        """Accepted samples."""
        return int(self.accepted.sum())


def accept(
    distances: FloatArray, rule: str, fraction: float, sample_id: IntArray, rng: np.random.Generator
) -> Acceptance:
    """Accept rows by one of the `RULES`.

    With max_rank this is the AND of one cut on each distance, at the one common quantile that lets the requested
    fraction pass.

    Parameters
    ----------
    distances
        Distance of each sample to the observation [n_kinds, n], the kinds in the order of `KINDS`.
    fraction
        Fraction to accept; the paper's 0.05. With marginal_and it applies to each distance.
    sample_id
        Identity of each row [n], all different. Each sample gets a random key that breaks ties, so that the
        order of the rows does not matter.
    rng
        Generator of the keys.

    Reference: Birrer+2017 sec. 5 ("reside in the best 5% of the sample"); docs/decisions.md.
    """
    cut_on = reduce_distances(distances, rule)
    score = max_rank(cut_on)
    n = score.size
    k = number_accepted(n, fraction)
    if rule == "marginal_and":  # every distance among the k smallest of its kind, ties included
        below = cut_on <= np.partition(cut_on, k - 1, axis=1)[:, k - 1, None]
        accepted: BoolArray = np.asarray(below.all(axis=0))
        implied = int(score[accepted].max()) / n if accepted.any() else fraction
        return Acceptance(accepted, score, fraction, int((below.sum(axis=1) - k).max()), implied, rule)
    key = np.empty(n)
    key[_order_by_id(sample_id, n)] = rng.random(n)
    chosen = np.lexsort((key, score))[:k]
    accepted = np.zeros(n, dtype=bool)
    accepted[chosen] = True
    cut = int(score[chosen[-1]])
    at_cut = score == cut
    n_tied = 0 if accepted[at_cut].all() else int(at_cut.sum())
    return Acceptance(accepted, score, fraction, n_tied, cut / n, rule)


def _order_by_id(sample_id: IntArray, n: int) -> IntArray:
    """Return the rows in ascending order of their identity [n]; reject repeated ones."""
    if sample_id.shape != (n,):
        raise ValueError(f"sample_id has shape {sample_id.shape}, expected ({n},)")
    order = np.argsort(sample_id, kind="stable")
    repeated = np.flatnonzero(np.diff(sample_id[order]) == 0)
    if repeated.size:
        raise ValueError(f"sample_id {sample_id[order][repeated[0]]} stands for more than one row")
    return order


def reduce_distances(distances: FloatArray, rule: str) -> FloatArray:
    """Return the distances that `rule` cuts on [n_cut, n]: all, one alone, or their scaled sum.

    Raises
    ------
    ValueError
        For an unknown rule, or for scaled_sum if more than half of the samples share a distance (scale 0).
    """
    if rule in ("max_rank", "marginal_and"):
        return distances
    if rule in KINDS:
        if distances.shape[0] != len(KINDS):
            raise ValueError(f"rule {rule!r} needs the distances {KINDS}, got {distances.shape[0]}")
        return distances[KINDS.index(rule)][None]
    if rule != "scaled_sum":
        raise ValueError(f"unknown rule {rule!r}; abc.acceptance is one of {', '.join(RULES)}")
    _check_distances(distances)
    scale = np.asarray(scipy.stats.median_abs_deviation(distances, axis=1))
    if not (scale > 0.0).all():
        raise ValueError(
            f"the median absolute deviation of distance {int(np.argmin(scale))} is 0: more than half of the "
            "samples share it, so that abc.acceptance: scaled_sum is undefined; use max_rank"
        )
    return (distances / scale[:, None]).sum(axis=0, keepdims=True)


def _check_distances(distances: FloatArray) -> None:
    if distances.ndim != 2 or distances.shape[0] < 1:
        raise ValueError(f"distances must be [n_kinds, n], got shape {distances.shape}")
    if not np.isfinite(distances).all():
        raise ValueError(
            f"{int((~np.isfinite(distances).all(axis=0)).sum())} of {distances.shape[1]} rows have a "
            "distance that is not finite; leave failed samples out of the table"
        )


def number_accepted(n: int, fraction: float) -> int:
    """Return k = round(fraction * n).

    Raises
    ------
    ValueError
        If the fraction is not in (0, 1] or accepts fewer than 2 samples.
    """
    if not 0.0 < fraction <= 1.0:
        raise ValueError(f"the accepted fraction must lie in (0, 1], got {fraction!r}")
    k = round(fraction * n)
    if k < 2:
        raise ValueError(
            f"a fraction {fraction} of n = {n} samples accepts {k}; at least 2 are needed: raise the "
            f"fraction to {2.0 / n if n > 1 else 1.0:.3g} or draw more samples"
        )
    return k


def max_rank(distances: FloatArray) -> IntArray:
    """Return r_j, the largest rank of row j over the kinds of distance [n], from 1 to n.

    The rank of a row is the number of rows that are as close or closer; distances [n_kinds, n] must be finite.

    Reference: docs/decisions.md, "best 5%".
    """
    _check_distances(distances)
    return scipy.stats.rankdata(distances, method="max", axis=1).astype(np.int64).max(axis=0)
