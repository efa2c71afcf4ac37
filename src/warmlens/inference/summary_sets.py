"""Sets of summaries on one table: which distances they cut on, and what each is worth.

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
from functools import partial

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
    """One summary of the samples [n, ...], the observation [...] and the null test's mocks [n_mocks, ...]."""

    samples: FloatArray
    observed: FloatArray
    null: FloatArray

    def each(self, change: Callable[[FloatArray], FloatArray]) -> Summary:
        """Return the summary with `change` applied to all three arrays."""
        return Summary(change(self.samples), change(self.observed), change(self.null))


def side_by_side(summaries: Mapping[str, Summary], names: tuple[str, ...]) -> Summary:
    """Join several summaries into one: [n, p], [p] and [n_mocks, p]."""
    flat = [_flat(summaries[name]) for name in names]
    return Summary(
        np.hstack([summary.samples for summary in flat]),
        np.hstack([summary.observed for summary in flat]),
        np.hstack([summary.null for summary in flat]),
    )


def _flat(summary: Summary) -> Summary:
    """Flatten the axes of the summary itself into one."""
    shape, size = summary.observed.shape, summary.observed.size
    return summary.each(lambda values: values.reshape(*values.shape[: values.ndim - len(shape)], size))


def points(summaries: Mapping[str, Summary], grids: Mapping[str, FloatArray], distance: str) -> dict[str, Summary]:
    """Return points whose squared distance is D, for each kind that the summaries have.

    Parameters
    ----------
    summaries
        By name: those of `PAPER` and `COUNTS`, and of `RESPONSE` if there are any.
    grids
        Grids of the summaries of `PAPER`.
    distance
        Of those of `PAPER`: "integral" of the squared difference, or "whitened". The others are always whitened.
    """
    points_of = {}
    for name in PAPER:
        summary = summaries[name]
        if distance == "whitened":
            points_of[name] = summary.each(whitening(summary.samples, summary.observed))
        else:
            points_of[name] = summary.each(partial(integral_features, grids[name]))
    kinds = {"counts": COUNTS} | ({"response": RESPONSE} if RESPONSE[0] in summaries else {})
    for name, parts in kinds.items():
        summary = side_by_side(summaries, parts)
        points_of[name] = summary.each(whitening(summary.samples, summary.observed))
    return points_of


def learned_points(
    parameters: FloatArray, summaries: Mapping[str, Summary], rng: np.random.Generator
) -> tuple[dict[str, Summary], LearnedSummaries]:
    """Return points of `LEARNED` from parameters [n, 2] and all summaries, and the regression that gave them."""
    joined = side_by_side(summaries, tuple(summaries))
    learned = learned_summaries(parameters, joined.samples, np.vstack([joined.observed, joined.null]), rng)
    points_of = {
        name: Summary(learned.samples[:, [i]], learned.observed[0, [i]], learned.observed[1:, [i]])
        for i, name in enumerate(LEARNED)
    }
    return points_of, learned


def kinds_of(name: str, available: Mapping[str, Summary]) -> tuple[str, ...]:
    """Return the available kinds of summaries that set `name` cuts on."""
    return tuple(kind for kind in SETS[name] if kind in available)


@dataclass(frozen=True)
class SummarySet:
    """Worth of a set of summaries on the table, with the headline bound of the observation.

    `gain` is over the same pseudo-observations for every set.
    """

    kinds: tuple[str, ...]
    gain: Information
    bound: Bound


def summary_set(table: Table, fraction: float, n_bootstrap: int, n_rows: int, streams: Streams) -> SummarySet:
    """Measure the worth of the summaries of a table by max-rank acceptance, with `n_rows` pseudo-observations.

    `streams` gives a generator per name; the same name gives the same numbers, so that sets can be compared.
    """
    distances = table.distances()
    accepted = accept(distances, "max_rank", fraction, table.sample_id, streams("ties"))
    bound = lower_bounds(table, accepted, distances, streams("bootstrap"), n_bootstrap=n_bootstrap)[HEADLINE]
    trials = leave_one_out(table, "max_rank", fraction, n_rows, streams("leave_one_out"))
    gain = information(table.m_kev, table.m_range_kev, trials, streams("information"))
    return SummarySet(table.kinds, gain, bound)
