"""Lower bound on the dark matter mass from the accepted samples, with its Monte-Carlo error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from warmlens.inference.acceptance import Acceptance, order_by_id
from warmlens.inference.bootstrap import bootstrap_counts, quantiles_of_counts, reached
from warmlens.types import FloatArray, IntArray

LEVELS = {"q05": 0.05, "q0455": 0.0455, "q02275": 0.02275}
HEADLINE = "q0455"
MIN_ACCEPTED = 50
MIN_BELOW_BOUND = 3.0


class TooFewError(ValueError):
    """An estimate that rests on too few samples to be quoted.

    Attributes
    ----------
    estimate
        What it would have been.
    """

    def __init__(self, message: str, estimate: float) -> None:
        super().__init__(message)
        self.estimate = estimate


@dataclass(frozen=True)
class Bound:
    """A one-sided lower bound on the thermal relic mass.

    Attributes
    ----------
    name, level
        E.g. "q0455", the 0.0455 quantile of the accepted samples: excluded at 95.45%.
    value_kev
        The bound [keV].
    mc_error_kev
        Its Monte-Carlo error [keV]: standard deviation over bootstrapped tables.
    prior_only_kev
        What the same quantile is without any data [keV].
    k, n
        Accepted and all samples.
    ess
        Kish effective size of the accepted samples; k without weights.
    warnings
        What a reader has to know before quoting the value; empty if nothing.
    """

    name: str
    level: float
    value_kev: float
    mc_error_kev: float
    prior_only_kev: float
    k: int
    n: int
    ess: float
    warnings: tuple[str, ...]

    @property
    def acceptance_fraction(self) -> float:
        """Fraction of the table that was accepted."""
        return self.k / self.n


def weighted_quantile(values: FloatArray, weights: FloatArray, levels: npt.ArrayLike) -> FloatArray:
    """Quantiles of the weighted empirical CDF: the smallest value at which it reaches the level.

    Parameters
    ----------
    values, weights
        Each [n]; weights >= 0, not all 0.
    levels
        In (0, 1], any shape; the shape of the result.
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


def uniform_prior_bound(low_kev: float, high_kev: float, level: float) -> float:
    """The bound that a uniform prior gives without data: 1.20, 1.18, 1.09 keV for U[1, 5]."""
    return low_kev + level * (high_kev - low_kev)


def effective_sample_size(weights: FloatArray) -> float:
    """Kish effective size (sum w)^2 / sum w^2 of weights [n]."""
    return float(weights.sum() ** 2 / np.square(weights).sum())


def lower_bounds(
    m_kev: FloatArray,
    acceptance: Acceptance,
    distances: FloatArray,
    sample_id: IntArray,
    prior_range_kev: tuple[float, float],
    rng: np.random.Generator,
    weights: FloatArray | None = None,
    n_bootstrap: int = 1000,
    counts: npt.NDArray[np.uint16] | None = None,
) -> dict[str, Bound]:
    """Bounds at every level of `LEVELS`.

    Parameters
    ----------
    m_kev
        Thermal relic mass of each sample [keV], [n].
    acceptance
        From `accept` on the same rows; its rule and fraction are those of the bootstrap too.
    distances
        The distances that it was given, [n_kinds, n].
    sample_id
        Identity of each row [n], all different; makes the result independent of the order of the rows.
    prior_range_kev
        Bounds of the uniform prior that the samples were drawn from [keV].
    rng
        Generator of the bootstrap.
    weights
        Prior weights of the samples [n]; all equal unless given.
    n_bootstrap
        Number of bootstrapped tables.
    counts
        From `bootstrap_counts` with these distances, rows in ascending order of their identity [n_bootstrap, n];
        made here unless given.

    Raises
    ------
    TooFewError
        If the rule marginal_and leaves fewer than `MIN_ACCEPTED` samples.

    Reference: docs/inference.md.
    """
    if not acceptance.n == m_kev.size == distances.shape[1]:
        raise ValueError(
            f"{m_kev.size} masses, {acceptance.n} rows of the acceptance and {distances.shape[1]} distances; "
            "all must be of one table"
        )
    low, high = prior_range_kev
    if not (np.isfinite(m_kev).all() and low < high and m_kev.min() >= low and m_kev.max() <= high):
        raise ValueError(f"masses from {m_kev.min()} to {m_kev.max()} keV leave the prior [{low}, {high}] keV")
    weight = np.ones(m_kev.size) if weights is None else weights
    levels = np.array(list(LEVELS.values()))
    accepted = acceptance.accepted
    if not accepted.any():
        raise TooFewError(f"the rule {acceptance.rule} accepts none of {acceptance.n} samples", np.nan)
    values = weighted_quantile(m_kev[accepted], weight[accepted], levels)
    if acceptance.rule == "marginal_and" and acceptance.k < MIN_ACCEPTED:
        raise TooFewError(
            f"abc.acceptance: marginal_and leaves {acceptance.k} of {acceptance.n} samples, at least "
            f"{MIN_ACCEPTED} are needed for a bound; raise abc.fraction = {acceptance.fraction:g} or use max_rank",
            float(values[list(LEVELS).index(HEADLINE)]),
        )
    ess = effective_sample_size(weight[accepted])
    if weights is None:
        prior_only = np.array([uniform_prior_bound(low, high, level) for level in levels])
    else:
        prior_only = weighted_quantile(m_kev, weights, levels)
    order = order_by_id(sample_id, m_kev.size)
    if counts is None:
        counts = bootstrap_counts(distances[:, order], acceptance.rule, [acceptance.fraction], n_bootstrap, rng)[0]
    replicates = quantiles_of_counts(m_kev[order], counts, levels, weight[order])
    errors = replicates.std(axis=0, ddof=1)
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
    """What has to be said next to a bound."""
    found = []
    if k < MIN_ACCEPTED:
        found.append(f"only {k} samples are accepted (fewer than {MIN_ACCEPTED})")
    elif ess < MIN_ACCEPTED:
        found.append(f"the weighted samples count as {ess:.1f} (fewer than {MIN_ACCEPTED})")
    if level * ess < MIN_BELOW_BOUND:
        found.append(f"the bound rests on {level * ess:.1f} samples below it (fewer than {MIN_BELOW_BOUND:g})")
    if value - prior_only <= 2.0 * error:
        found.append(
            f"indistinguishable from the prior: {value:.2f} +- {error:.2f} keV against {prior_only:.2f} keV "
            "without data"
        )
    return tuple(found)
