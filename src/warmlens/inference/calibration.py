"""Leave-one-out calibration: samples of the table play the observation against the rest.

Reference: Prangle+2013, arXiv:1301.3166 (coverage in ABC); Talts+2018, arXiv:1804.06788 (rank statistics).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # and of it what is used, when it is used: scipy.stats takes a second to load

from warmlens.inference.acceptance import accept, number_accepted, reduce_distances
from warmlens.inference.adjustment import MIN_ACCEPTED as MIN_TO_ADJUST
from warmlens.inference.adjustment import adjust
from warmlens.inference.bootstrap import quantiles_of_counts
from warmlens.inference.bound import LEVELS, weighted_quantile
from warmlens.inference.table import Table
from warmlens.types import BoolArray, FloatArray, IntArray

MIN_ROWS = 300
CDM_LIKE_KEV = 4.5
MASS_BINS_KEV = {"below 2 keV": (0.0, 2.0), "2 to 3 keV": (2.0, 3.0), "above 3 keV": (3.0, np.inf)}
MIN_KS_P = 0.01
CONFIDENCE = 0.95
BATCH = 100


@dataclass(frozen=True)
class LeaveOneOut:
    """What the procedure says of samples whose truth is known.

    Attributes
    ----------
    rows
        Rows of the table that played the observation [n_rows].
    truth
        Their parameters [n_rows, 2].
    accepted
        What was accepted for each [n_rows, n]; never the row itself.
    pit
        Rank of the truth among the accepted samples, over k + 1 and spread evenly within its step
        [n_rows, 2]: uniform on (0, 1) if calibrated.
    bounds
        Quantiles of the accepted relic masses at every level of `LEVELS` [n_rows, n_levels] [keV].
    adjusted_pit, adjusted_bounds
        The same of the regression adjustment; None if it was not asked for or too few are accepted.
    """

    rows: IntArray
    truth: FloatArray
    accepted: BoolArray
    pit: FloatArray
    bounds: FloatArray
    adjusted_pit: FloatArray | None
    adjusted_bounds: FloatArray | None


def leave_one_out(
    table: Table, rule: str, fraction: float, n_rows: int, rng: np.random.Generator, with_adjustment: bool = False
) -> LeaveOneOut:
    """Run acceptance and bound for rows of the table as if each were the observation.

    Parameters
    ----------
    table
        Its own observation plays no part.
    rule, fraction
        Those of the inference; the fraction is that of the other n - 1 samples.
    n_rows
        How many rows, drawn without replacement; all if there are not more.
    rng
        Generator of the rows, of tie-breaking, and of the spread of the ranks.
    with_adjustment
        Whether the regression adjustment is run too.
    """
    n = table.n
    rows = np.sort(rng.choice(n, min(n_rows, n), replace=False))
    parameters, features = table.parameters, table.stacked()
    with_adjustment = with_adjustment and number_accepted(n - 1, fraction) >= MIN_TO_ADJUST
    levels = np.array(list(LEVELS.values()))
    accepted = np.zeros((rows.size, n), dtype=bool)
    pit, adjusted_pit = np.empty((rows.size, 2)), np.full((rows.size, 2), np.nan)
    adjusted_bounds = np.full((rows.size, levels.size), np.nan)
    others = np.arange(n - 1)
    for start in range(0, rows.size, BATCH):
        batch = rows[start : start + BATCH]
        all_distances = table.distances_between(batch)  # [n_kinds, n_batch, n]
        for i, row in enumerate(batch, start=start):
            rest = np.delete(np.arange(n), row)
            distances = all_distances[:, i - start, rest]
            result = accept(distances, rule, fraction, others, rng)
            chosen = rest[result.accepted]
            accepted[i, chosen] = True
            pit[i] = _pit(parameters[chosen], np.ones(chosen.size), parameters[row], rng)
            if with_adjustment and result.k >= MIN_TO_ADJUST:
                adjusted = adjust(
                    parameters[chosen],
                    table.ranges,
                    features[chosen],
                    features[row],
                    reduce_distances(distances, rule)[:, result.accepted],
                    np.ones(chosen.size, dtype=bool),
                )
                adjusted_pit[i] = _pit(adjusted.values, adjusted.weights, parameters[row], rng)
                adjusted_bounds[i] = weighted_quantile(adjusted.values[:, 0], adjusted.weights, levels)
    some = accepted.any(axis=1)  # the rule marginal_and may accept nothing: such a row has no bound
    bounds = np.full((rows.size, levels.size), np.nan)
    bounds[some] = quantiles_of_counts(table.m_kev, accepted[some], levels)
    return LeaveOneOut(
        rows=rows,
        truth=parameters[rows],
        accepted=accepted,
        pit=pit,
        bounds=bounds,
        adjusted_pit=adjusted_pit if np.isfinite(adjusted_pit).all() else None,
        adjusted_bounds=adjusted_bounds if np.isfinite(adjusted_bounds).all() else None,
    )


def _pit(values: FloatArray, weights: FloatArray, truth: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Position of the truth [n_parameters] among weighted values [k, n_parameters], spread over its step.

    The truth is one more sample, of the mean weight; ties are spread too.
    """
    u = rng.random(truth.size)
    if weights.size == 0:
        return u
    own = weights.sum() / np.count_nonzero(weights)
    below = weights @ (values < truth)
    tied = weights @ (values == truth)
    return (below + u * (own + tied)) / (weights.sum() + own)


@dataclass(frozen=True)
class Coverage:
    """How often the truth lay above a bound.

    Attributes
    ----------
    n, n_covered
        Trials, and those with the truth at or above the bound.
    low, high
        Clopper-Pearson interval of the probability at `CONFIDENCE`.
    nominal
        What it should be on average over the prior: 1 - level.
    """

    n: int
    n_covered: int
    low: float
    high: float
    nominal: float

    @property
    def fraction(self) -> float:
        """Measured coverage; NaN without trials."""
        return self.n_covered / self.n if self.n else np.nan

    @property
    def nominal_inside(self) -> bool:
        """Whether the interval contains the nominal coverage."""
        return self.low <= self.nominal <= self.high


def coverage(bounds: FloatArray, truth: FloatArray, level: float) -> Coverage:
    """Coverage of lower bounds [n] of true values [n], both [keV]; bounds that are NaN do not count."""
    known = np.isfinite(bounds)
    n, covered = int(known.sum()), int((truth[known] >= bounds[known]).sum())
    low, high = clopper_pearson(covered, n)
    return Coverage(n, covered, low, high, 1.0 - level)


def coverage_by_mass(bounds: FloatArray, truth: FloatArray, level: float) -> dict[str, Coverage]:
    """Coverage for the true masses of `MASS_BINS_KEV`; the nominal one holds on average over all only."""
    return {
        name: coverage(bounds[inside], truth[inside], level)
        for name, (low, high) in MASS_BINS_KEV.items()
        for inside in [(truth >= low) & (truth < high)]
    }


def clopper_pearson(successes: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Interval of a binomial probability that contains it at least as often as `confidence` says."""
    tail = 0.5 * (1.0 - confidence)
    quantile = scipy.stats.beta.ppf
    low = 0.0 if successes == 0 else float(quantile(tail, successes, trials - successes + 1))
    high = 1.0 if successes == trials else float(quantile(1.0 - tail, successes + 1, trials - successes))
    return low, high


@dataclass(frozen=True)
class RankTest:
    """Uniformity of rank statistics.

    Attributes
    ----------
    ks_statistic, ks_p
        Kolmogorov-Smirnov test against the uniform distribution.
    grid
        Points in (0, 1) [n_grid].
    ecdf
        Fraction of the ranks at or below each [n_grid].
    band
        Lower and upper edge that uniform ranks leave anywhere with probability 5% only [2, n_grid].
    """

    ks_statistic: float
    ks_p: float
    grid: FloatArray
    ecdf: FloatArray
    band: FloatArray

    @property
    def inside_band(self) -> bool:
        """Whether the ECDF stays within the band everywhere."""
        return bool(((self.ecdf >= self.band[0]) & (self.ecdf <= self.band[1])).all())


def rank_test(pit: FloatArray, rng: np.random.Generator, n_grid: int = 50, n_simulated: int = 2000) -> RankTest:
    """Test positions of the truth [n] for uniformity.

    Reference: simultaneous ECDF band after Saeilynoja, Buerkner & Vehtari 2022, Stat. Comput. 32, 32, of
    simulated uniform ranks.
    """
    grid = np.arange(1, n_grid + 1) / (n_grid + 1)
    ks = scipy.stats.kstest(pit, "uniform")
    simulated = rng.multinomial(pit.size, np.full(n_grid + 1, 1.0 / (n_grid + 1)), size=n_simulated)
    steps = np.sort(np.cumsum(simulated, axis=1)[:, :-1] / pit.size, axis=0)  # [n_simulated, n_grid], each sorted
    ecdf = np.searchsorted(np.sort(pit), grid, side="right") / pit.size
    walks = np.cumsum(simulated, axis=1)[:, :-1] / pit.size
    # the pointwise tail that 95% of the walks never enter
    below = np.stack(
        [np.searchsorted(column, walk, "right") for column, walk in zip(steps.T, walks.T, strict=True)]
    )
    above = n_simulated - np.stack(
        [np.searchsorted(column, walk, "left") for column, walk in zip(steps.T, walks.T, strict=True)]
    )
    depth = np.minimum(below, above).min(axis=0)  # of each walk: how far out its outermost point lies
    tail = max(int(np.quantile(depth, 1.0 - CONFIDENCE)), 1)
    return RankTest(float(ks.statistic), float(ks.pvalue), grid, ecdf, np.stack([steps[tail - 1], steps[-tail]]))


@dataclass(frozen=True)
class ExpectedLimit:
    """Bounds that CDM-like truths lead to.

    Attributes
    ----------
    n
        Truths above `CDM_LIKE_KEV`.
    quantiles_kev
        5, 16, 50, 84 and 95% quantiles of their bounds [keV].
    median_error_kev
        Standard deviation of the median over bootstrapped truths [keV].
    observed_percentile
        Percentage of these bounds below the observed one.
    """

    n: int
    quantiles_kev: tuple[float, ...]
    median_error_kev: float
    observed_percentile: float


def expected_limit(
    bounds: FloatArray, truth: FloatArray, observed_bound: float, rng: np.random.Generator
) -> ExpectedLimit | None:
    """Expected limit of CDM-like truths from bounds and true masses [n] [keV]; None below 10 such truths."""
    found = bounds[(truth > CDM_LIKE_KEV) & np.isfinite(bounds)]
    if found.size < 10:
        return None
    quantiles = np.quantile(found, [0.05, 0.16, 0.5, 0.84, 0.95])
    medians = np.median(rng.choice(found, (500, found.size)), axis=1)
    percentile = 100.0 * float(np.mean(found < observed_bound) + 0.5 * np.mean(found == observed_bound))
    return ExpectedLimit(found.size, tuple(map(float, quantiles)), float(medians.std(ddof=1)), percentile)
