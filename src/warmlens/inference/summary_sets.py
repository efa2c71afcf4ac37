"""Sets of summaries on one and the same table: which distances they cut on, and what each is worth.

paper
    C(dr) and the cumulative distribution, each with its own distance (Birrer+2017); `correlation` and
    `cumulative` are one of them alone.
sharper
    The linear response (mean z^2 and correlation of the amplitude) and the counts (positions below several
    thresholds, with the chi2 of the smooth fit), each whitened. Without the amplitude among the statistics of the
    scan only the counts.
learned
    The parameters as regressed on all summaries (Fearnhead & Prangle 2012); `learned_m` the relic mass alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from warmlens.inference.acceptance import accept
from warmlens.inference.bound import HEADLINE, Bound, lower_bounds
from warmlens.inference.calibration import leave_one_out
from warmlens.inference.distance import integral_features, whitening
from warmlens.inference.information import Information, information
from warmlens.inference.learned import LearnedSummaries, learned_summaries
from warmlens.inference.table import Table
from warmlens.types import FloatArray

PAPER = ("correlation", "cumulative")
COUNTS = ("counts", "chi2")
RESPONSE = ("mean_z2", "amplitude_correlation")  # only with the statistic `amplitude` of the scan
LEARNED = ("learned_m", "learned_mass")
SETS = {
    "paper": PAPER,
    **{kind: (kind,) for kind in PAPER},
    "sharper": ("response", "counts"),
    "learned": LEARNED,
    "learned_m": LEARNED[:1],
}
Streams = Callable[[str], np.random.Generator]


@dataclass(frozen=True)
class Summary:
    """One summary, of everything that is compared.

    Attributes
    ----------
    samples, observed, null
        Of the samples [n, ...], of the observation [...], of the null test's mocks [n_mocks, ...].
    """

    samples: FloatArray
    observed: FloatArray
    null: FloatArray

    def each(self, change: Callable[[FloatArray], FloatArray]) -> Summary:
        """The same with all three arrays changed."""
        return Summary(change(self.samples), change(self.observed), change(self.null))


def side_by_side(summaries: Mapping[str, Summary], names: tuple[str, ...]) -> Summary:
    """Several summaries as one: [n, p], [p] and [n_mocks, p]."""
    flat = [_flat(summaries[name]) for name in names]
    return Summary(
        np.hstack([item.samples for item in flat]),
        np.hstack([item.observed for item in flat]),
        np.hstack([item.null for item in flat]),
    )


def _flat(item: Summary) -> Summary:
    """A summary of any shape as numbers in a row."""
    shape, size = item.observed.shape, item.observed.size
    return item.each(lambda values: values.reshape(*values.shape[: values.ndim - len(shape)], size))


def points(summaries: Mapping[str, Summary], grids: Mapping[str, FloatArray], distance: str) -> dict[str, Summary]:
    """Points whose squared distance is D, of the kinds that the summaries have.

    Parameters
    ----------
    summaries
        By name: those of `PAPER` and `COUNTS`, and of `RESPONSE` if there are any.
    grids
        On which those of `PAPER` are taken.
    distance
        Of these: "integral" of the squared difference, or "whitened". The others are whitened always.
    """
    found = {}
    for name in PAPER:
        item = summaries[name]
        if distance == "whitened":
            found[name] = item.each(whitening(item.samples, item.observed))
        else:
            found[name] = item.each(lambda values, grid=grids[name]: integral_features(grid, values))  # type: ignore[misc]
    kinds = {"counts": COUNTS} | ({"response": RESPONSE} if RESPONSE[0] in summaries else {})
    for name, parts in kinds.items():
        item = side_by_side(summaries, parts)
        found[name] = item.each(whitening(item.samples, item.observed))
    return found


def learned_points(
    parameters: FloatArray, summaries: Mapping[str, Summary], rng: np.random.Generator
) -> tuple[dict[str, Summary], LearnedSummaries]:
    """Points of `LEARNED` from parameters [n, 2] and all summaries; with what was learned.

    Raises
    ------
    ValueError
        If there are too few samples to learn from.
    """
    item = side_by_side(summaries, tuple(summaries))
    learned = learned_summaries(parameters, item.samples, np.vstack([item.observed, item.null]), rng)
    found = {
        name: Summary(learned.samples[:, [i]], learned.observed[0, [i]], learned.observed[1:, [i]])
        for i, name in enumerate(LEARNED)
    }
    return found, learned


def kinds_of(name: str, known: Mapping[str, Summary]) -> tuple[str, ...]:
    """Kinds of summaries that set `name` cuts on, of those that are known."""
    return tuple(kind for kind in SETS[name] if kind in known)


@dataclass(frozen=True)
class SummarySet:
    """What a set of summaries is worth on the table.

    Attributes
    ----------
    kinds
        What it cuts on.
    gain
        Information over the prior and expected bound, over the same pseudo-observations for every set.
    bound
        The headline bound of the observation with this set.
    """

    kinds: tuple[str, ...]
    gain: Information
    bound: Bound


def summary_set(table: Table, fraction: float, n_bootstrap: int, n_rows: int, streams: Streams) -> SummarySet:
    """Worth of the summaries of a table by max-rank acceptance.

    Parameters
    ----------
    table
        With this set's kinds.
    fraction, n_bootstrap
        Of the acceptance, and of the bounds' errors.
    n_rows
        Pseudo-observations.
    streams
        A generator for each name; the same name gives the same numbers, so that sets can be compared.
    """
    distances = table.distances()
    accepted = accept(distances, "max_rank", fraction, table.sample_id, streams("ties"))
    bound = lower_bounds(table, accepted, distances, streams("bootstrap"), n_bootstrap=n_bootstrap)[HEADLINE]
    trials = leave_one_out(table, "max_rank", fraction, n_rows, streams("leave_one_out"))
    gain = information(table.m_kev, table.m_range_kev, trials, streams("information"))
    return SummarySet(table.kinds, gain, bound)
