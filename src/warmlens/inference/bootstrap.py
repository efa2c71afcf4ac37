"""Bootstrapped tables: whole rows are drawn with replacement *before* the acceptance.

`Counts` say how often each row is accepted in each bootstrapped table. Quantiles and densities of the accepted
samples are products with these counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

import numpy as np
import numpy.typing as npt
import scipy  # scipy.stats takes 1 s to import; scipy loads it on first use

from warmlens.inference.acceptance import max_rank, number_accepted, reduce_distances
from warmlens.inference.memory import row_batches
from warmlens.types import BoolArray, FloatArray, IntArray

DRAWN_ELEMENTS = 500_000  # of a batch of tables; another number draws other tables
Counts = npt.NDArray[np.uint8]  # a row is drawn once on average; 255 times never happens


class AllCounts(Sequence[Counts]):
    """Counts [n_bootstrap, n] of several fractions, kept without the rows that no table of a batch accepts."""

    def __init__(self, n_fractions: int, n_bootstrap: int, n: int) -> None:
        self._shape = (n_bootstrap, n)
        self._parts: list[list[tuple[int, npt.NDArray[np.int32], Counts]]] = [[] for _ in range(n_fractions)]

    def add(self, fraction: int, start: int, counts: IntArray) -> None:
        """Keep the counts of the tables from number `start` on [size, n]."""
        rows = np.flatnonzero(counts.any(axis=0)).astype(np.int32)
        self._parts[fraction].append((start, rows, counts[:, rows].astype(np.uint8)))

    def __len__(self) -> int:
        return len(self._parts)

    @overload
    def __getitem__(self, index: int) -> Counts: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Counts]: ...
    def __getitem__(self, index: int | slice) -> Counts | Sequence[Counts]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        whole = np.zeros(self._shape, dtype=np.uint8)
        for start, rows, counts in self._parts[index]:
            whole[start : start + len(counts), rows] = counts
        return whole


def bootstrap_counts(
    distances: FloatArray, rule: str, fractions: Sequence[float], n_bootstrap: int, rng: np.random.Generator
) -> AllCounts:
    """Count how often each bootstrapped table accepts each row: [n_bootstrap, n] for each fraction.

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
    result = AllCounts(len(ks), n_bootstrap, n)
    batch = max(1, DRAWN_ELEMENTS // n)
    for start in range(0, n_bootstrap, batch):
        size = min(batch, n_bootstrap - start)
        times = rng.multinomial(n, np.full(n, 1.0 / n), size=size)  # [size, n]
        if rule == "marginal_and":
            closer = np.zeros((size, n), dtype=np.int64)  # the larger number of rows that are strictly closer
            for order, first in zip(by_distance, first_as_close, strict=True):
                cumulative = np.cumsum(times[:, order], axis=1)
                np.maximum(closer, np.pad(cumulative, ((0, 0), (1, 0)))[:, first], out=closer)
            for i, k in enumerate(ks):
                result.add(i, start, np.where(closer < k, times, 0))
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
            taken = np.zeros_like(times)
            np.put_along_axis(taken, best, np.clip(k - before, 0, times_best), axis=1)
            result.add(i, start, taken)
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
    quantiles, empty = np.empty((counts.shape[0], levels.size)), 0
    for batch in row_batches(*counts.shape):
        ordered = counts[batch][:, order]
        terms = ordered.astype(np.int64) if weights is None else ordered * weights[order]
        cumulative = np.cumsum(terms, axis=1)
        empty += int((cumulative[:, -1] <= 0.0).sum())
        for i, level in enumerate(reached(levels)):
            quantiles[batch, i] = values[order][np.argmax(cumulative >= level * cumulative[:, -1:], axis=1)]
    if empty:
        raise ValueError(
            f"the weights leave nothing of the accepted samples in {empty} of {counts.shape[0]} bootstrapped "
            "tables; this prior is not covered by the samples"
        )
    return quantiles


def reached(level: FloatArray) -> FloatArray:
    """Lower a level by the rounding of a cumulative sum, so that 5 of 100 equal weights do reach 0.05."""
    return level * (1.0 - 1e-12)
