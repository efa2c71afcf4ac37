"""Which samples of the table count as close to the observation: four rules.

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
import scipy  # and of it what is used, when it is used: scipy.stats takes a second to load

from warmlens.types import BoolArray, FloatArray, IntArray

KINDS = ("correlation", "cumulative")
JOINT_RULES = ("max_rank", "marginal_and", "scaled_sum")
RULES = (*JOINT_RULES, *KINDS)


@dataclass(frozen=True)
class Acceptance:
    """The accepted rows of a table of n samples.

    Attributes
    ----------
    accepted
        True for the accepted rows [n].
    max_rank
        r_j, the larger of the ranks of row j among all distances of a kind (1 is closest) [n].
    fraction
        Fraction that was asked for.
    n_tied
        Rows that share the score at the cut, when some of them are accepted and some are not; 0 otherwise.
    implied_quantile
        Common quantile of all distances below which the accepted rows lie: the largest accepted r_j / n.
    rule
        One of `RULES`.
    """

    accepted: BoolArray
    max_rank: IntArray
    fraction: float
    n_tied: int
    implied_quantile: float
    rule: str = "max_rank"

    @property
    def n(self) -> int:
        """Number of samples in the table."""
        return self.accepted.size

    @property
    def k(self) -> int:
        """Number of accepted samples."""
        return int(self.accepted.sum())


def accept(
    distances: FloatArray, rule: str, fraction: float, sample_id: IntArray, rng: np.random.Generator
) -> Acceptance:
    """Accept rows by one of the `RULES`.

    Parameters
    ----------
    distances
        Distance of each sample to the observation, [n_kinds, n]; the kinds in the order of `KINDS`.
    rule
        One of `RULES`.
    fraction
        Fraction to accept; the paper's 0.05. With marginal_and it is that of each distance.
    sample_id
        Identity of each row [n], all different, see `accept_max_rank`.
    rng
        Generator of the keys that break ties.
    """
    reduced = reduce_distances(distances, rule)
    if rule == "marginal_and":
        return _accept_marginal(reduced, fraction)
    result = accept_max_rank(reduced, fraction, sample_id, rng)
    return Acceptance(result.accepted, result.max_rank, fraction, result.n_tied, result.implied_quantile, rule)


def reduce_distances(distances: FloatArray, rule: str) -> FloatArray:
    """The distances that `rule` cuts on [n_cut, n]: all, one alone, or their scaled sum.

    Raises
    ------
    ValueError
        For an unknown rule, or for scaled_sum if more than half of the samples share a distance: its scale is
        then 0.
    """
    if distances.ndim != 2 or distances.shape[0] < 1:
        raise ValueError(f"distances must be [n_kinds, n], got shape {distances.shape}")
    if rule in ("max_rank", "marginal_and"):
        return distances
    if rule in KINDS:
        if distances.shape[0] != len(KINDS):
            raise ValueError(f"rule {rule!r} needs the distances {KINDS}, got {distances.shape[0]}")
        return distances[KINDS.index(rule)][None]
    if rule != "scaled_sum":
        raise ValueError(f"unknown rule {rule!r}; abc.acceptance is one of {', '.join(RULES)}")
    _refuse_infinite(distances)
    scale = np.asarray(scipy.stats.median_abs_deviation(distances, axis=1))
    if not (scale > 0.0).all():
        raise ValueError(
            f"the median absolute deviation of distance {int(np.argmin(scale))} is 0: more than half of the "
            "samples share it, so that abc.acceptance: scaled_sum is undefined; use max_rank"
        )
    return (distances / scale[:, None]).sum(axis=0, keepdims=True)


def _accept_marginal(distances: FloatArray, fraction: float) -> Acceptance:
    """Rows of which every distance is among the k smallest of its kind, ties included."""
    score = max_rank(distances)
    k = number_accepted(score.size, fraction)
    cut = np.partition(distances, k - 1, axis=1)[:, k - 1, None]  # the k-th smallest
    below = distances <= cut
    accepted: BoolArray = np.asarray(below.all(axis=0))
    n_tied = int((below.sum(axis=1) - k).max())
    implied = int(score[accepted].max()) / score.size if accepted.any() else fraction
    return Acceptance(accepted, score, fraction, n_tied, implied, "marginal_and")


def _refuse_infinite(distances: FloatArray) -> None:
    if not np.isfinite(distances).all():
        raise ValueError(
            f"{int((~np.isfinite(distances).all(axis=0)).sum())} of {distances.shape[1]} rows have a "
            "distance that is not finite; leave failed samples out of the table"
        )


def number_accepted(n: int, fraction: float) -> int:
    """k = round(fraction * n), refused below 2.

    Raises
    ------
    ValueError
        Naming n and the fraction, when it is not in (0, 1] or leaves fewer than 2 samples.
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
    """r_j = max over the kinds of distance of the rank of row j.

    Parameters
    ----------
    distances
        [n_kinds, n], finite. The rank of a row is the number of rows that are as close or closer.

    Returns
    -------
    r
        [n], from 1 to n.

    Reference: docs/decisions.md, "best 5%".
    """
    if distances.ndim != 2 or distances.shape[0] < 1:
        raise ValueError(f"distances must be [n_kinds, n], got shape {distances.shape}")
    _refuse_infinite(distances)
    return scipy.stats.rankdata(distances, method="max", axis=1).astype(np.int64).max(axis=0)


def accept_max_rank(
    distances: FloatArray, fraction: float, sample_id: IntArray, rng: np.random.Generator
) -> Acceptance:
    """Accept the k = round(fraction * n) rows with the smallest max-rank.

    This is the AND of one cut on each distance, at the one common quantile that lets the asked fraction pass.

    Parameters
    ----------
    distances
        Distance of each sample to the observation, [n_kinds, n].
    fraction
        Fraction to accept; the paper's 0.05.
    sample_id
        Identity of each row [n], all different. Ties are broken by a random key that belongs to the sample,
        so that the order of the rows has no say.
    rng
        Generator of the keys.

    Reference: Birrer+2017 sec. 5 ("reside in the best 5% of the sample"); docs/decisions.md.
    """
    score = max_rank(distances)
    n = score.size
    k = number_accepted(n, fraction)
    key = np.empty(n)
    key[order_by_id(sample_id, n)] = rng.random(n)
    chosen = np.lexsort((key, score))[:k]
    accepted = np.zeros(n, dtype=bool)
    accepted[chosen] = True
    cut = int(score[chosen[-1]])
    at_cut = score == cut
    n_tied = 0 if accepted[at_cut].all() else int(at_cut.sum())
    return Acceptance(accepted, score, fraction, n_tied, cut / n)


def order_by_id(sample_id: IntArray, n: int) -> IntArray:
    """Rows in ascending order of their identity [n]; refuses repeated ones."""
    if sample_id.shape != (n,):
        raise ValueError(f"sample_id has shape {sample_id.shape}, expected ({n},)")
    order = np.argsort(sample_id, kind="stable")
    repeated = np.flatnonzero(np.diff(sample_id[order]) == 0)
    if repeated.size:
        raise ValueError(f"sample_id {sample_id[order][repeated[0]]} stands for more than one row")
    return order
