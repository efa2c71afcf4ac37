"""Lower bound on the dark matter mass from the accepted samples, with its Monte-Carlo error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from warmlens.inference.acceptance import Acceptance
from warmlens.inference.bootstrap import Counts, bootstrap_counts, quantiles_of_counts, reached
from warmlens.inference.table import Table
from warmlens.types import FloatArray

LEVELS = {"q05": 0.05, "q0455": 0.0455, "q02275": 0.02275}
LEVEL_VALUES = np.array(list(LEVELS.values()))  # [n_levels]
HEADLINE = "q0455"
HEADLINE_INDEX = list(LEVELS).index(HEADLINE)
MIN_FOR_BOUND = 50
MIN_BELOW_BOUND = 3.0
MIN_EXCESS = 3.0  # errors above the prior alone; without any information 2 to 3% of the bounds reach 2


class TooFewError(ValueError):
    """Too few samples to quote a value; `estimate` is what it would have been."""

    def __init__(self, message: str, estimate: float) -> None:
        super().__init__(message)
        self.estimate = estimate


@dataclass(frozen=True)
class Bound:
    """A one-sided lower bound on the thermal relic mass."""

    # E.g. "q0455", the 0.0455 quantile of the accepted samples: excluded at 95.45%.
    name: str
    level: float
    value_kev: float  # the bound [keV]
    mc_error_kev: float  # its Monte-Carlo error [keV]: standard deviation over bootstrapped tables
    prior_only_kev: float  # the same quantile of all samples of the table, accepted or not [keV]
    # Accepted and all samples
    k: int
    n: int
    ess: float  # Kish effective size of the accepted samples; k without weights
    warnings: tuple[str, ...]  # what a reader must know before quoting the value


def weighted_quantile(values: FloatArray, weights: FloatArray, levels: npt.ArrayLike) -> FloatArray:
    """Return quantiles of the weighted empirical CDF: the smallest value at which it reaches the level.

    `values` and `weights` are [n]; weights >= 0, not all 0. `levels` in (0, 1] have the shape of the result.
    """
    level = np.asarray(levels, dtype=np.float64)
    if values.ndim != 1 or values.shape != weights.shape or not np.isfinite(values).all():
        raise ValueError(f"values must be finite and as long as weights, got {values.shape}, {weights.shape}")
    if not (np.isfinite(weights).all() and (weights >= 0.0).all() and weights.sum() > 0.0):
        raise ValueError("weights must be finite, >= 0 and not all 0")
    if not ((level > 0.0) & (level <= 1.0)).all():
        raise ValueError(f"levels must lie in (0, 1], got {levels!r}")
    order = np.argsort(values, kind="stable")
    cumulative = np.cumsum(weights[order])
    return values[order][np.searchsorted(cumulative, reached(level) * cumulative[-1])]


def effective_sample_size(weights: FloatArray) -> float:
    """Return the Kish effective size (sum w)^2 / sum w^2 of weights [n]."""
    return float(weights.sum() ** 2 / np.square(weights).sum())


def lower_bounds(
    table: Table,
    acceptance: Acceptance,
    distances: FloatArray,
    rng: np.random.Generator,
    weights: FloatArray | None = None,
    n_bootstrap: int = 1000,
    counts: Counts | None = None,
) -> dict[str, Bound]:
    """Return the bound at every level of `LEVELS`.

    Parameters
    ----------
    acceptance
        From `accept` on the rows of `table`; the bootstrap uses its rule and fraction.
    distances
        The distances that `accept` cut on [n_kinds, n].
    rng
        Generator of the bootstrap.
    weights
        Prior weights of the samples [n]; equal by default.
    n_bootstrap
        Number of bootstrapped tables, if `counts` is None.
    counts
        From `bootstrap_counts` with these distances [n_bootstrap, n].

    Raises
    ------
    TooFewError
        If the rule marginal_and leaves fewer than `MIN_FOR_BOUND` samples.

    Reference: docs/inference.md.
    """
    m_kev = table.m_kev
    if not acceptance.n == table.n == distances.shape[1]:
        raise ValueError(
            f"{table.n} masses, {acceptance.n} rows of the acceptance and {distances.shape[1]} distances; "
            "all must be of one table"
        )
    weight = np.ones(table.n) if weights is None else weights
    accepted = acceptance.accepted
    if not accepted.any():
        raise TooFewError(f"the rule {acceptance.rule} accepts none of {acceptance.n} samples", np.nan)
    values = weighted_quantile(m_kev[accepted], weight[accepted], LEVEL_VALUES)
    if acceptance.rule == "marginal_and" and acceptance.k < MIN_FOR_BOUND:
        raise TooFewError(
            f"abc.acceptance: marginal_and leaves {acceptance.k} of {acceptance.n} samples, at least "
            f"{MIN_FOR_BOUND} are needed for a bound; "
            f"raise abc.fraction = {acceptance.fraction:g} or use max_rank",
            float(values[HEADLINE_INDEX]),
        )
    ess = effective_sample_size(weight[accepted])
    prior_only = weighted_quantile(m_kev, weight, LEVEL_VALUES)
    if counts is None:
        counts = bootstrap_counts(distances, acceptance.rule, [acceptance.fraction], n_bootstrap, rng)[0]
    errors = quantiles_of_counts(m_kev, counts, LEVEL_VALUES, weight).std(axis=0, ddof=1)
    return {
        name: Bound(
            name=name,
            level=level,
            value_kev=float(values[i]),
            mc_error_kev=float(errors[i]),
            prior_only_kev=float(prior_only[i]),
            k=acceptance.k,
            n=acceptance.n,
            ess=ess,
            warnings=_warnings(level, values[i], errors[i], prior_only[i], acceptance.k, ess),
        )
        for i, (name, level) in enumerate(LEVELS.items())
    }


def _warnings(level: float, value: float, error: float, prior_only: float, k: int, ess: float) -> tuple[str, ...]:
    warnings = [text for text in (count_warning(k), prior_warning(value, error, prior_only)) if text]
    if ess < MIN_FOR_BOUND <= k:
        warnings.append(f"the weighted samples count as {ess:.1f} (fewer than {MIN_FOR_BOUND})")
    if level * ess < MIN_BELOW_BOUND:
        warnings.append(f"the bound rests on {level * ess:.1f} samples below it (fewer than {MIN_BELOW_BOUND:g})")
    return tuple(warnings)


def count_warning(k: int) -> str:
    """Say that too few samples are accepted; "" if enough are."""
    return f"only {k} samples are accepted (fewer than {MIN_FOR_BOUND})" if k < MIN_FOR_BOUND else ""


def prior_warning(value: float, error: float, prior_only: float) -> str:
    """Say that a bound does not exceed that of the prior alone by more than its error [keV]; "" if it does."""
    numbers = f"{value:.2f} +- {error:.2f} keV against {prior_only:.2f} keV without data"
    if prior_only - value > MIN_EXCESS * error:
        return f"below that of the prior: {numbers}; the image prefers light relics, of which no lower bound tells"
    if value - prior_only <= MIN_EXCESS * error:
        return f"indistinguishable from the prior: {numbers}"
    return ""
