"""Bootstrapped tables: whole rows are drawn with replacement *before* the acceptance.

`Counts` say how often each row is accepted in each bootstrapped table. Quantiles and densities of the accepted
samples are products with these counts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy  # scipy.stats takes 1 s to import; scipy loads it on first use

from warmlens.inference.acceptance import max_rank, number_accepted, reduce_distances
from warmlens.types import BoolArray, FloatArray, IntArray

BATCH_ELEMENTS = 500_000
Counts = npt.NDArray[np.uint16]


def bootstrap_counts(
    distances: FloatArray, rule: str, fractions: Sequence[float], n_bootstrap: int, rng: np.random.Generator
) -> Counts:
    """Count how often each bootstrapped table accepts each row, at each fraction [n_fractions, n_bootstrap, n].

    Parameters
    ----------
    distances
        [n_kinds, n]; the rows in an order that does not depend on the run, such as that of their identity.
    rule
        One of `acceptance.RULES`. The scales of scaled_sum are those of the table itself.
    fractions, n_bootstrap
        Accepted fractions, all of the same tables; number of tables, >= 2.

    Notes
    -----
    The rows are sorted once by each distance. Ranks in a bootstrapped table are then cumulative sums of the
    numbers of rows, for all tables of a batch at once.
    """
    if n_bootstrap < 2:
        raise ValueError(f"n_bootstrap must be >= 2, got {n_bootstrap}")
    distances = reduce_distances(distances, rule)
    max_rank(distances)  # rejects distances without a rank
    n = distances.shape[1]
    ks = [number_accepted(n, fraction) for fraction in fractions]
    by_distance = np.argsort(distances, axis=1, kind="stable")
    last_as_close = scipy.stats.rankdata(distances, method="max", axis=1).astype(np.int64) - 1  # [n_kinds, n]
    first_as_close = scipy.stats.rankdata(distances, method="min", axis=1).astype(np.int64) - 1
    result = np.empty((len(ks), n_bootstrap, n), dtype=np.uint16)
    batch = max(1, BATCH_ELEMENTS // n)
    for start in range(0, n_bootstrap, batch):
        size = min(batch, n_bootstrap - start)
        times = rng.multinomial(n, np.full(n, 1.0 / n), size=size)  # [size, n]
        if rule == "marginal_and":
            closer = np.zeros((size, n), dtype=np.int64)  # the larger number of rows that are strictly closer
            for order, first in zip(by_distance, first_as_close, strict=True):
                cumulative = np.cumsum(times[:, order], axis=1)
                np.maximum(closer, np.pad(cumulative, ((0, 0), (1, 0)))[:, first], out=closer)
            for i, k in enumerate(ks):
                result[i, start : start + size] = np.where(closer < k, times, 0)
            continue
        score = np.zeros((size, n))
        for order, last in zip(by_distance, last_as_close, strict=True):
            rank = np.cumsum(times[:, order], axis=1)[:, last]  # rows of the table as close or closer
            np.maximum(score, rank, out=score)
        score += rng.random((size, n))  # breaks ties: scores are whole numbers
        best = np.argsort(score, axis=1)
        times_best = np.take_along_axis(times, best, axis=1)
        before = np.cumsum(times_best, axis=1) - times_best
        for i, k in enumerate(ks):
            taken = np.clip(k - before, 0, times_best).astype(np.uint16)
            np.put_along_axis(result[i, start : start + size], best, taken, axis=1)
    return result


def quantiles_of_counts(
    values: FloatArray,
    counts: Counts | IntArray | BoolArray,
    levels: FloatArray,
    weights: FloatArray | None = None,
) -> FloatArray:
    """Return quantiles of many selections of the same rows [n_selections, n_levels].

    They are those of the weighted empirical CDF, see `bound.weighted_quantile`.

    Parameters
    ----------
    values, weights
        Of the rows, each [n]; equal weights by default.
    counts
        How often each row is selected [n_selections, n].
    levels
        [n_levels].

    Raises
    ------
    ValueError
        If a selection has no weight.
    """
    order = np.argsort(values, kind="stable")
    ordered = counts[:, order]
    terms = ordered.astype(np.int64) if weights is None else ordered * weights[order]
    cumulative = np.cumsum(terms, axis=1)
    empty = int((cumulative[:, -1] <= 0.0).sum())
    if empty:
        raise ValueError(
            f"the weights leave nothing of the accepted samples in {empty} of {counts.shape[0]} bootstrapped "
            "tables; this prior is not covered by the samples"
        )
    quantiles = np.empty((counts.shape[0], levels.size))
    for i, level in enumerate(reached(levels)):
        quantiles[:, i] = values[order][np.argmax(cumulative >= level * cumulative[:, -1:], axis=1)]
    return quantiles


def reached(level: FloatArray) -> FloatArray:
    """Lower a level by the rounding of a cumulative sum, so that 5 of 100 equal weights do reach 0.05."""
    return level * (1.0 - 1e-12)
