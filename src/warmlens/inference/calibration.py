"""Leave-one-out calibration: samples of the table play the observation against the rest.

Reference: Prangle+2013, arXiv:1301.3166 (coverage in ABC); Talts+2018, arXiv:1804.06788 (rank statistics).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # scipy.stats takes 1 s to import; scipy loads it on first use

from warmlens.inference.acceptance import accept, number_accepted, reduce_distances
from warmlens.inference.adjustment import MIN_FOR_REGRESSION, adjust
from warmlens.inference.bootstrap import quantiles_of_counts
from warmlens.inference.bound import LEVEL_VALUES, weighted_quantile
from warmlens.inference.memory import row_batches
from warmlens.inference.table import Table
from warmlens.types import BoolArray, FloatArray, IntArray

MIN_ROWS = 300
CDM_LIKE_KEV = 4.5
MASS_BINS_KEV = {"below 2 keV": (0.0, 2.0), "2 to 3 keV": (2.0, 3.0), "above 3 keV": (3.0, np.inf)}
MIN_KS_P = 0.01
CONFIDENCE = 0.95
TOO_LOW_P = 1e-3  # probability of so few covered truths, below which the bound is too strong
BATCH = 100


@dataclass(frozen=True)
class LeaveOneOut:
    """Results of the inference for samples whose truth is known.

    Attributes
    ----------
    rows, truth
        Rows of the table that played the observation [n_rows], and their parameters [n_rows, 2].
    accepted
        Accepted samples for each [n_rows, n]; never the row itself.
    pit
        Rank of the truth among the accepted samples, divided by k + 1 and spread evenly within its step
        [n_rows, 2]: uniform on (0, 1) if calibrated.
    bounds
        Quantiles of the accepted relic masses at every level of `LEVELS` [n_rows, n_levels] [keV].
    adjusted_pit, adjusted_bounds
        The same of the regression adjustment; None if it was not requested or too few samples are accepted.
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
        Its observation is not used.
    rule, fraction
        Rule of acceptance, and the fraction of the other n - 1 samples to accept.
    n_rows
        Number of rows, drawn without replacement; at most n are.
    rng
        Generator of the rows, of tie-breaking, and of the spread of the ranks.
    with_adjustment
        Whether to run the regression adjustment too.
    """
    n = table.n
    rows = np.sort(rng.choice(n, min(n_rows, n), replace=False))
    parameters, features = table.parameters, table.stacked()
    with_adjustment = with_adjustment and number_accepted(n - 1, fraction) >= MIN_FOR_REGRESSION
    accepted = np.zeros((rows.size, n), dtype=bool)
    pit, adjusted_pit = np.empty((rows.size, 2)), np.full((rows.size, 2), np.nan)
    adjusted_bounds = np.full((rows.size, LEVEL_VALUES.size), np.nan)
    others = np.arange(n - 1)
    for batch in row_batches(rows.size, n, BATCH):
        all_distances = table.distances_between(rows[batch])  # [n_kinds, n_batch, n]
        for i, row in enumerate(rows[batch], start=batch.start):
            rest = np.delete(np.arange(n), row)
            distances = all_distances[:, i - batch.start, rest]
            result = accept(distances, rule, fraction, others, rng)
            chosen = rest[result.accepted]
            accepted[i, chosen] = True
            pit[i] = _pit(parameters[chosen], np.ones(chosen.size), parameters[row], rng)
            if with_adjustment and result.k >= MIN_FOR_REGRESSION:
                adjusted = adjust(
                    parameters[chosen],
                    table.ranges,
                    features[chosen],
                    features[row],
                    reduce_distances(distances, rule)[:, result.accepted],
                    np.ones(chosen.size, dtype=bool),
                )
                adjusted_pit[i] = _pit(adjusted.values, adjusted.weights, parameters[row], rng)
                adjusted_bounds[i] = weighted_quantile(adjusted.values[:, 0], adjusted.weights, LEVEL_VALUES)
    some = accepted.any(axis=1)  # the rule marginal_and may accept nothing: such a row has no bound
    bounds = np.full((rows.size, LEVEL_VALUES.size), np.nan)
    bounds[some] = quantiles_of_counts(table.m_kev, accepted[some], LEVEL_VALUES)
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
    """Return the rank of the truth [n_parameters] among weighted values [k, n_parameters], spread over its step.

    The truth counts as one more sample of the mean weight; ties are spread too.
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
    """Frequency with which a bound lies below the truth.

    Attributes
    ----------
    n, n_covered
        Trials, and those with the truth at or above the bound.
    low, high
        Clopper-Pearson interval of the probability at `CONFIDENCE`.
    nominal
        Expected coverage on average over the prior: 1 - level.
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

    @property
    def too_low(self) -> bool:
        """Whether the truth lies above its bound too seldom to be chance: the bound is too strong."""
        return bool(scipy.stats.binom.cdf(self.n_covered, self.n, self.nominal) < TOO_LOW_P)


def coverage(bounds: FloatArray, truth: FloatArray, level: float) -> Coverage:
    """Measure the coverage of lower bounds [n] of true values [n], both [keV]; NaN bounds do not count."""
    finite = np.isfinite(bounds)
    n, covered = int(finite.sum()), int((truth[finite] >= bounds[finite]).sum())
    low, high = clopper_pearson(covered, n)
    return Coverage(n, covered, low, high, 1.0 - level)


def coverage_by_mass(bounds: FloatArray, truth: FloatArray, level: float) -> dict[str, Coverage]:
    """Measure the coverage in each of `MASS_BINS_KEV`; it is nominal only on average over all masses."""
    return {
        name: coverage(bounds[inside], truth[inside], level)
        for name, (low, high) in MASS_BINS_KEV.items()
        for inside in [(truth >= low) & (truth < high)]
    }


def clopper_pearson(successes: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return the interval that contains a binomial probability with at least the given confidence."""
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
    grid, ecdf
        Points in (0, 1), and the fraction of the ranks at or below each [n_grid].
    band
        Simultaneous 95% band of the ECDF of uniform ranks: lower and upper edge [2, n_grid].
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

    Reference: Saeilynoja, Buerkner & Vehtari 2022, Stat. Comput. 32, 32 (ECDF band from simulated uniform ranks).
    """
    grid = np.arange(1, n_grid + 1) / (n_grid + 1)
    ks = scipy.stats.kstest(pit, "uniform")
    simulated = rng.multinomial(pit.size, np.full(n_grid + 1, 1.0 / (n_grid + 1)), size=n_simulated)
    walks = np.cumsum(simulated, axis=1)[:, :-1] / pit.size  # [n_simulated, n_grid]
    steps = np.sort(walks, axis=0)
    ecdf = np.searchsorted(np.sort(pit), grid, side="right") / pit.size
    columns = list(zip(steps.T, walks.T, strict=True))
    below = np.stack([np.searchsorted(step, walk, "right") for step, walk in columns])
    above = n_simulated - np.stack([np.searchsorted(step, walk, "left") for step, walk in columns])
    depth = np.minimum(below, above).min(axis=0)  # rank of the outermost point of each walk
    tail = max(int(np.quantile(depth, 1.0 - CONFIDENCE)), 1)  # 95% of the walks never enter it at any point
    return RankTest(float(ks.statistic), float(ks.pvalue), grid, ecdf, np.stack([steps[tail - 1], steps[-tail]]))


@dataclass(frozen=True)
class ExpectedLimit:
    """Bounds of trials with a CDM-like truth."""

    # Number of truths above `CDM_LIKE_KEV`; 5, 16, 50, 84 and 95% quantiles of their bounds [keV]
    n: int
    quantiles_kev: tuple[float, ...]
    median_error_kev: float  # standard deviation of the median over bootstrapped truths [keV]
    observed_percentile: float  # percentage of these bounds below the observed one


def expected_limit(
    bounds: FloatArray, truth: FloatArray, observed_bound: float, rng: np.random.Generator
) -> ExpectedLimit | None:
    """Return the expected limit from bounds and true masses [n] [keV]; None below 10 CDM-like truths."""
    cold = bounds[(truth > CDM_LIKE_KEV) & np.isfinite(bounds)]
    if cold.size < 10:
        return None
    quantiles = np.quantile(cold, [0.05, 0.16, 0.5, 0.84, 0.95])
    medians = np.median(rng.choice(cold, (500, cold.size)), axis=1)
    percentile = 100.0 * float(np.mean(cold < observed_bound) + 0.5 * np.mean(cold == observed_bound))
    return ExpectedLimit(cold.size, tuple(map(float, quantiles)), float(medians.std(ddof=1)), percentile)
