"""Dependence of the bound on the accepted fraction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from warmlens.inference.acceptance import accept, number_accepted, reduce_distances
from warmlens.inference.adjustment import MIN_FOR_REGRESSION, adjust, adjusted_quantiles_of_counts, local_scores
from warmlens.inference.bootstrap import Counts, bootstrap_counts, quantiles_of_counts
from warmlens.inference.bound import HEADLINE_INDEX, LEVEL_VALUES, MIN_FOR_BOUND, weighted_quantile
from warmlens.inference.table import Table
from warmlens.types import FloatArray

FRACTIONS = (0.20, 0.10, 0.05, 0.03, 0.02, 0.01)
CONVERGED, NOT_CONVERGED, TOO_FEW = "converged", "not converged", "too few samples to tell"


@dataclass(frozen=True)
class Step:
    """The headline bound and its Monte-Carlo error [keV] at one acceptance fraction, with k accepted samples.

    `raw` is without, `adjusted` with the regression adjustment: None below `MIN_FOR_REGRESSION` samples.
    """

    fraction: float
    k: int
    raw_kev: float
    raw_error_kev: float
    adjusted_kev: float | None
    adjusted_error_kev: float | None


@dataclass(frozen=True)
class Convergence:
    """The bound at falling acceptance fractions.

    Attributes
    ----------
    steps
        Fractions in descending order; those that would accept fewer than 2 samples are left out.
    raw, adjusted
        Verdicts, each one of `CONVERGED`, `NOT_CONVERGED` and `TOO_FEW`.
    adjusted_replicates
        Adjusted bounds of the bootstrapped tables at the fraction of the inference [n_bootstrap, n_levels]
        [keV]; None if there is no adjustment.
    """

    steps: tuple[Step, ...]
    raw: str
    adjusted: str
    adjusted_replicates: FloatArray | None


def threshold_convergence(
    table: Table,
    rule: str,
    fraction: float,
    n_bootstrap: int,
    rng: np.random.Generator,
    fractions: Sequence[float] = FRACTIONS,
) -> tuple[Convergence, Counts]:
    """Compare the headline bound at several acceptance fractions, all with the same bootstrapped tables.

    It has converged if successive bounds differ by no more than the Monte-Carlo error of the one with fewer
    samples. At least three bounds are compared, from twice the fraction of the inference down to the last one
    that accepts `bound.MIN_FOR_BOUND` samples; adjusted bounds at all fractions that have one.

    Parameters
    ----------
    rule, fraction
        Those of the inference; its fraction joins `fractions`.

    Returns the convergence, and the counts of the bootstrapped tables at `fraction` [n_bootstrap, n].
    """
    distances, headline = table.distances(), LEVEL_VALUES[[HEADLINE_INDEX]]
    used = sorted({*fractions, fraction}, reverse=True)
    used = [value for value in used if value == fraction or round(value * table.n) >= 2]
    counts = bootstrap_counts(distances, rule, used, n_bootstrap, rng)
    reduced = reduce_distances(distances, rule)
    features, observed = table.stacked(), np.concatenate(table.observed)
    steps, kept = [], None
    for value, selections in zip(used, counts, strict=True):
        result = accept(distances, rule, value, table.sample_id, rng)
        if result.k < 2 or not selections.any(axis=1).all():
            continue
        one = np.ones(result.k)
        raw = float(weighted_quantile(table.m_kev[result.accepted], one, headline)[0])
        error = float(quantiles_of_counts(table.m_kev, selections, headline).std(ddof=1))
        adjusted_kev = adjusted_error = None
        if min(result.k, number_accepted(table.n, value)) >= MIN_FOR_REGRESSION:
            moved = adjust(table.parameters, table.ranges, features, observed, reduced, result.accepted)
            scores = local_scores(features, features[result.accepted], observed)
            replicates = adjusted_quantiles_of_counts(
                table.m_kev, table.m_range_kev, scores, reduced, selections, LEVEL_VALUES
            )
            adjusted_kev = float(weighted_quantile(moved.values[:, 0], moved.weights, headline)[0])
            adjusted_error = float(replicates[:, HEADLINE_INDEX].std(ddof=1))
            if value == fraction:
                kept = replicates
        steps.append(Step(value, result.k, raw, error, adjusted_kev, adjusted_error))
    near = [step for step in steps if step.fraction <= 2.0 * fraction and step.k >= MIN_FOR_BOUND]
    raw_pairs = [(step.raw_kev, step.raw_error_kev) for step in near]
    adjusted_pairs = [
        (step.adjusted_kev, step.adjusted_error_kev)
        for step in steps
        if step.adjusted_kev is not None and step.adjusted_error_kev is not None
    ]
    convergence = Convergence(tuple(steps), _verdict(raw_pairs), _verdict(adjusted_pairs), kept)
    return convergence, counts[used.index(fraction)]


def _verdict(bounds_and_errors: Sequence[tuple[float, float]]) -> str:
    """Return whether successive bounds agree within the Monte-Carlo error of the later one."""
    if len(bounds_and_errors) < 3:
        return TOO_FEW
    agree = all(abs(after - before) <= error for (before, _), (after, error) in pairwise(bounds_and_errors))
    return CONVERGED if agree else NOT_CONVERGED
