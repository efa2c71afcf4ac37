"""Lower bound on the dark matter mass from the accepted samples, with its Monte-Carlo error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import rankdata

from warmlens.inference.acceptance import Acceptance, max_rank, number_accepted, order_by_id
from warmlens.types import FloatArray, IntArray

LEVELS = {"q05": 0.05, "q0455": 0.0455, "q02275": 0.02275}
HEADLINE = "q0455"
MIN_ACCEPTED = 50
MIN_BELOW_BOUND = 3.0
BATCH_ELEMENTS = 500_000


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
    return values[order][np.searchsorted(cumulative, _reached(level) * cumulative[-1])]


def _reached(level: FloatArray) -> FloatArray:
    """A level less the rounding of a cumulative sum, so that 5 of 100 equal weights do reach 0.05."""
    return level * (1.0 - 1e-12)


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
) -> dict[str, Bound]:
    """Bounds at every level of `LEVELS`.

    Parameters
    ----------
    m_kev
        Thermal relic mass of each sample [keV], [n].
    acceptance
        From `accept_max_rank` on the same rows.
    distances
        The distances that it used, [n_kinds, n].
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

    Reference: docs/decisions.md, "Summaries and inference".
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
    values = weighted_quantile(m_kev[accepted], weight[accepted], levels)
    ess = effective_sample_size(weight[accepted])
    if weights is None:
        prior_only = np.array([uniform_prior_bound(low, high, level) for level in levels])
    else:
        prior_only = weighted_quantile(m_kev, weights, levels)
    order = order_by_id(sample_id, m_kev.size)
    replicates = bootstrap_bounds(
        m_kev[order], distances[:, order], acceptance.fraction, levels, n_bootstrap, rng, weight[order]
    )
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


def bootstrap_bounds(
    m_kev: FloatArray,
    distances: FloatArray,
    fraction: float,
    levels: FloatArray,
    n_bootstrap: int,
    rng: np.random.Generator,
    weights: FloatArray,
) -> FloatArray:
    """Bounds of tables whose whole rows are drawn with replacement *before* the acceptance.

    Parameters
    ----------
    m_kev, weights
        Each [n].
    distances
        [n_kinds, n].
    fraction
        Accepted fraction, of each table anew.
    levels
        [n_levels].
    n_bootstrap
        Number of tables, >= 2.
    rng
        Generator; the result depends on the order of the rows, see `lower_bounds`.

    Returns
    -------
    bounds
        [n_bootstrap, n_levels] [keV].

    Notes
    -----
    A table is the number of times that each row occurs. Ranks are then cumulative sums of these numbers along
    the rows sorted once by each distance, so that all tables of a batch are handled at once.
    """
    if n_bootstrap < 2:
        raise ValueError(f"n_bootstrap must be >= 2, got {n_bootstrap}")
    n = m_kev.size
    k = number_accepted(n, fraction)
    by_mass = np.argsort(m_kev, kind="stable")  # ascending mass from here on: the quantile is then one sum
    m_kev, distances, weights = m_kev[by_mass], distances[:, by_mass], weights[by_mass]
    max_rank(distances)  # refuses what has no rank
    by_distance = np.argsort(distances, axis=1, kind="stable")
    last_as_close = rankdata(distances, method="max", axis=1).astype(np.int64) - 1  # [n_kinds, n]
    bounds = np.empty((n_bootstrap, levels.size))
    batch = max(1, BATCH_ELEMENTS // n)
    for start in range(0, n_bootstrap, batch):
        size = min(batch, n_bootstrap - start)
        times = rng.multinomial(n, np.full(n, 1.0 / n), size=size)  # [size, n]
        score = np.zeros((size, n))
        for order, last in zip(by_distance, last_as_close, strict=True):
            rank = np.cumsum(times[:, order], axis=1)[:, last]  # rows of the table as close or closer
            np.maximum(score, rank, out=score)
        score += rng.random((size, n))  # breaks ties: scores are whole numbers
        best = np.argsort(score, axis=1)
        times_best = np.take_along_axis(times, best, axis=1)
        before = np.cumsum(times_best, axis=1) - times_best
        taken = np.empty((size, n), dtype=np.int64)
        np.put_along_axis(taken, best, np.clip(k - before, 0, times_best), axis=1)
        cumulative = np.cumsum(taken * weights, axis=1)
        empty = int((cumulative[:, -1] <= 0.0).sum())
        if empty:
            raise ValueError(
                f"the weights leave nothing of the accepted samples in {empty} of {size} bootstrapped "
                "tables; this prior is not covered by the samples"
            )
        for i, level in enumerate(_reached(levels)):
            bounds[start : start + size, i] = m_kev[np.argmax(cumulative >= level * cumulative[:, -1:], axis=1)]
    return bounds


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
