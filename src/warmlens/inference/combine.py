"""Several lenses: likelihood ratios multiply, posteriors do not, since the prior would count once a lens.

B(m) of a lens is marginal over its own halo mass. A density of k samples says nothing of ratios below about
1 / k of its maximum; B is kept above that, so that no lens excludes more than its samples can show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warmlens.inference.bound import LEVELS
from warmlens.inference.calibration import CDM_LIKE_KEV, LeaveOneOut
from warmlens.inference.likelihood import BoundaryKernels, LikelihoodRatio, crossing
from warmlens.inference.table import Table
from warmlens.types import FloatArray

LENSES = (1, 2, 4, 8, 16, 32)
NOISE_FACTORS = (0.5, 0.7, 1.0, 1.4, 2.0)
N_DRAWS = 300
N_TABLES = 30


@dataclass(frozen=True)
class Combined:
    """What several lenses say together, under a uniform prior over the range that all of them cover.

    Attributes
    ----------
    m_kev, ratio
        Grid [n_grid] [keV], and the product of the likelihood ratios, 1 at its upper end.
    replicates
        The product for bootstrapped tables of each lens [n_bootstrap, n_grid].
    bounds_kev, mc_errors_kev, prior_only_kev
        Quantiles of the posterior at every level of `bound.LEVELS`, their errors, and those of the prior [keV].
    """

    m_kev: FloatArray
    ratio: FloatArray
    replicates: FloatArray
    bounds_kev: dict[str, float]
    mc_errors_kev: dict[str, float]
    prior_only_kev: dict[str, float]

    def falls_to(self, ratio: float) -> float | None:
        """Largest mass at which the product is down to `ratio` [keV]; None if it is not within the range."""
        value = float(crossing(self.m_kev, self.ratio[None], ratio)[0])
        return None if np.isnan(value) else value


def resolved_log_ratio(ratio: FloatArray, k: int) -> FloatArray:
    """log B of [..., n_grid], not below 1 / k of the largest of each row."""
    return np.log(np.maximum(ratio, ratio.max(axis=-1, keepdims=True) / k))


def combine(lenses: Sequence[LikelihoodRatio]) -> Combined:
    """Multiply the likelihood ratios of independent lenses.

    Raises
    ------
    ValueError
        If there is none, or no mass that all of them cover.
    """
    if not lenses:
        raise ValueError("no lens to combine")
    low = max(lens.m_kev[0] for lens in lenses)
    high = min(lens.m_kev[-1] for lens in lenses)
    if not low < high:
        raise ValueError(f"the lenses have no relic mass in common: up to {high:g} keV and from {low:g} keV")
    grid = np.linspace(low, high, max(lens.m_kev.size for lens in lenses))
    n_replicates = min(len(lens.replicates) for lens in lenses)
    total, replicates = np.zeros(grid.size), np.zeros((n_replicates, grid.size))
    for lens in lenses:
        total += np.interp(grid, lens.m_kev, resolved_log_ratio(lens.ratio, lens.k))
        rows = resolved_log_ratio(lens.replicates[:n_replicates], lens.k)
        replicates += np.array([np.interp(grid, lens.m_kev, row) for row in rows])
    levels = np.array(list(LEVELS.values()))
    values, scatter = (
        posterior_quantiles(grid, total[None], levels)[0],
        posterior_quantiles(grid, replicates, levels),
    )
    errors = scatter.std(axis=0, ddof=1)
    prior = low + levels * (high - low)
    return Combined(
        grid,
        np.exp(total - total[-1]),
        np.exp(replicates - replicates[:, -1:]),
        dict(zip(LEVELS, map(float, values), strict=True)),
        dict(zip(LEVELS, map(float, errors), strict=True)),
        dict(zip(LEVELS, map(float, prior), strict=True)),
    )


def posterior_quantiles(grid: FloatArray, log_ratio: FloatArray, levels: FloatArray) -> FloatArray:
    """Quantiles [n, n_levels] of the posterior under a uniform prior of log B [n, n_grid] on an even grid."""
    density = np.exp(log_ratio - log_ratio.max(axis=1, keepdims=True))
    steps = 0.5 * (density[:, 1:] + density[:, :-1])
    cdf = np.concatenate([np.zeros((len(density), 1)), np.cumsum(steps, axis=1)], axis=1)
    cdf /= cdf[:, -1:]
    index = np.clip((cdf[:, None, :] < levels[:, None]).sum(axis=2), 1, grid.size - 1)  # [n, n_levels]
    rows = np.arange(len(cdf))[:, None]
    below, above = cdf[rows, index - 1], cdf[rows, index]
    part = np.divide(levels - below, above - below, out=np.zeros_like(below), where=above > below)
    return grid[index - 1] + part * (grid[index] - grid[index - 1])


@dataclass(frozen=True)
class Forecast:
    """Expected bound from lenses like this one, if dark matter is cold.

    Attributes
    ----------
    n_lenses, noise_factor
        How many, and by what the noise is multiplied.
    median_kev, low_kev, high_kev
        Median and central 68% of the bound [keV].
    median_error_kev
        Standard deviation of the median over bootstrapped tables and pseudo-observations [keV].
    """

    n_lenses: int
    noise_factor: float
    median_kev: float
    low_kev: float
    high_kev: float
    median_error_kev: float


def forecast(
    m_kev: FloatArray, ratios: Sequence[FloatArray], k: int, level: float, rng: np.random.Generator
) -> tuple[Forecast, ...]:
    """Expected bound against the number of lenses, and for one lens against its noise.

    Parameters
    ----------
    m_kev
        Grid [n_grid] [keV].
    ratios
        B(m) of leave-one-out trials with a truth above `CDM_LIKE_KEV`, each [n_trials, n_grid]: first that of the
        table, then of bootstrapped tables, from `cold_ratios`.
    k
        Accepted samples of a trial.
    level
        Of the bound.
    rng
        Generator.

    Returns
    -------
    forecasts
        Empty below 10 such trials.

    Notes
    -----
    All trials share one table, whose chance excesses multiply with every lens: the error, of bootstrapped trials
    of bootstrapped tables, says for how many lenses the table is large enough.

    Noise multiplied by f leaves 1 / f^2 of the information: B becomes B^(1 / f^2), exact for summaries that are
    linear with Gaussian noise of the observation alone. The scatter of the substructure itself, which better
    images do not lower, is scaled too: for f < 1 the forecast is what could be gained at best.
    """
    if len(ratios[0]) < 10:
        return ()
    tables = [resolved_log_ratio(ratio, k) for ratio in ratios]
    n_trials = len(tables[0])
    cases = [(n, 1.0) for n in LENSES] + [(1, f) for f in NOISE_FACTORS if f != 1.0]
    found = []
    for n_lenses, factor in cases:
        bounds = []
        for i, table in enumerate(tables):
            pool = np.arange(n_trials) if i == 0 else rng.integers(0, n_trials, n_trials)
            drawn = pool[rng.integers(0, n_trials, (N_DRAWS, n_lenses))]
            total = np.zeros((N_DRAWS, m_kev.size))
            for column in drawn.T:
                total += table[column] / factor**2
            bounds.append(posterior_quantiles(m_kev, total, np.array([level]))[:, 0])
        low, median, high = np.quantile(bounds[0], [0.16, 0.5, 0.84])
        error = float(np.median(bounds[1:], axis=1).std(ddof=1))
        found.append(Forecast(n_lenses, factor, float(median), float(low), float(high), error))
    return tuple(found)


def cold_ratios(
    table: Table, trials: LeaveOneOut, like: LikelihoodRatio, rng: np.random.Generator, n_tables: int = N_TABLES
) -> list[FloatArray]:
    """B(m) of the trials with a truth above `CDM_LIKE_KEV`: of the table, then of bootstrapped tables.

    Parameters
    ----------
    table, trials
        The table, and its leave-one-out trials.
    like
        Gives grid and bandwidth.
    rng
        Generator of the bootstrapped tables.
    n_tables
        Number of these.

    Returns
    -------
    ratios
        1 + n_tables arrays [n_trials, n_grid].
    """
    kernels = BoundaryKernels(like.m_kev, table.m_kev, like.bandwidth_kev, table.m_range_kev)
    accepted = trials.accepted[trials.truth[:, 0] > CDM_LIKE_KEV]
    accepted = accepted[accepted.any(axis=1)]
    times = rng.multinomial(table.n, np.full(table.n, 1.0 / table.n), size=n_tables)
    return [kernels.ratio(accepted), *(kernels.ratio(accepted, row) for row in times)]
