"""What each set of summaries is worth on one and the same table: the paper's, its parts, and learned ones."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from warmlens.inference.acceptance import accept
from warmlens.inference.bound import HEADLINE, Bound, lower_bounds
from warmlens.inference.calibration import leave_one_out
from warmlens.inference.information import Information, information
from warmlens.inference.table import Table
from warmlens.summaries.learned import learned_summaries
from warmlens.types import FloatArray


@dataclass(frozen=True)
class SummarySet:
    """A set of summaries on the table.

    Attributes
    ----------
    gain
        Information over the prior and expected bound, over the same pseudo-observations for every set.
    bound
        The headline bound of the observation with this set.
    r_squared
        For learned ones: predicted fraction of the variance of m_kev and of log10_mass; None otherwise.
    """

    gain: Information
    bound: Bound
    r_squared: tuple[float, ...] | None


def summary_sets(
    table: Table,
    fraction: float,
    n_bootstrap: int,
    n_rows: int,
    streams: Callable[[str], np.random.Generator],
    sharper: FloatArray | None = None,
    sharper_observed: FloatArray | None = None,
) -> dict[str, SummarySet]:
    """Compare summary sets by max-rank acceptance at one fraction.

    Parameters
    ----------
    table
        With the paper's two kinds of summaries.
    fraction, n_bootstrap
        Of the acceptance, and of the bounds' errors.
    n_rows
        Pseudo-observations.
    streams
        A generator for each name; the same name gives the same numbers.
    sharper, sharper_observed
        Further summaries for the learned ones [n, n_features], [n_features], such as those of
        `summaries.response`; None: the paper's alone.
    """
    features, observed = table.stacked(), np.concatenate(table.observed)
    if sharper is not None and sharper_observed is not None:
        features, observed = np.hstack([features, sharper]), np.concatenate([observed, sharper_observed])
    learned = learned_summaries(table.parameters, features, observed, streams("learned"))
    both = tuple(learned.samples[:, [i]] for i in range(2))
    both_observed = tuple(learned.observed[[i]] for i in range(2))
    sets = {
        "paper": table,
        "correlation": dataclasses.replace(table, features=table.features[:1], observed=table.observed[:1]),
        "cumulative": dataclasses.replace(table, features=table.features[1:], observed=table.observed[1:]),
        "learned": dataclasses.replace(table, features=both, observed=both_observed),
        "learned_m": dataclasses.replace(table, features=both[:1], observed=both_observed[:1]),
    }
    found = {}
    for name, rows in sets.items():
        distances = rows.distances()
        accepted = accept(distances, "max_rank", fraction, rows.sample_id, streams("ties"))
        bound = lower_bounds(
            rows.m_kev,
            accepted,
            distances,
            rows.sample_id,
            rows.m_range_kev,
            streams("summary_sets"),
            n_bootstrap=n_bootstrap,
        )[HEADLINE]
        trials = leave_one_out(rows, "max_rank", fraction, n_rows, streams("summary_sets"))
        gain = information(rows.m_kev, rows.m_range_kev, trials, streams("summary_sets"))
        r_squared = tuple(map(float, learned.r_squared)) if name.startswith("learned") else None
        found[name] = SummarySet(gain, bound, r_squared)
    return found
