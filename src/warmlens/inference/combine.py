"""Combine several lenses: likelihood ratios multiply; posteriors do not, as the prior would count once per lens.

B(m) of a lens is marginal over its own halo mass. A density of k samples cannot resolve ratios below about
1 / k of its maximum. B is kept above that, so that no lens excludes more than its samples can show.
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
    """Posterior from several lenses under a uniform prior over the range that all of them cover.

    Attributes
    ----------
    m_kev, ratio
        Grid [n_grid] [keV], and the product of the likelihood ratios, 1 at its upper end.
    replicates
        The product for bootstrapped tables of each lens [n_bootstrap, n_grid].
    bounds_kev, mc_errors_kev, prior_only_kev
        Quantiles of the posterior per level of `bound.LEVELS`, their errors, and quantiles of the prior [keV].
    """

    m_kev: FloatArray
    ratio: FloatArray
    replicates: FloatArray
    bounds_kev: dict[str, float]
    mc_errors_kev: dict[str, float]
    prior_only_kev: dict[str, float]

    def falls_to(self, ratio: float) -> float | None:
        """Return the largest mass at which the product is down to `ratio` [keV]; None outside the range."""
        value = float(crossing(self.m_kev, self.ratio[None], ratio)[0])
        return None if np.isnan(value) else value


def resolved_log_ratio(ratio: FloatArray, k: int) -> FloatArray:
    """Return log B of [..., n_grid], not below 1 / k of the largest of each row."""
    return np.log(np.maximum(ratio, ratio.max(axis=-1, keepdims=True) / k))


def combine(lenses: Sequence[LikelihoodRatio]) -> Combined:
    """Multiply the likelihood ratios of independent lenses; ValueError if no mass is covered by all of them."""
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
    values = posterior_quantiles(grid, total[None], levels)[0]
    errors = posterior_quantiles(grid, replicates, levels).std(axis=0, ddof=1)
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
    """Return posterior quantiles [n, n_levels] under a uniform prior, of log B [n, n_grid] on an even grid."""
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
    """Expected bound from `n_lenses` like this one, if dark matter is cold: median and central 68%.

    `median_error_kev` is the standard deviation over bootstrapped tables and pseudo-observations. The noise of
    the images is multiplied by `noise_factor`.
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
    """Forecast the bound against the number of lenses, and for one lens against its noise; () below 10 trials.

    Parameters
    ----------
    m_kev
        Grid [n_grid] [keV].
    ratios
        From `cold_ratios`: B(m) of trials, [n_trials, n_grid] for the table and each bootstrapped table.
    k
        Accepted samples of a trial.
    level
        Probability below the bound.

    Notes
    -----
    All trials share one table, whose chance excesses multiply with every lens. The error, of bootstrapped trials
    of bootstrapped tables, shows for how many lenses the table is large enough.

    Noise multiplied by f leaves 1 / f^2 of the information: B becomes B^(1 / f^2). This is exact for summaries
    that are linear with Gaussian noise of the observation alone. The scatter of the substructure itself, which
    better images do not lower, is scaled too: for f < 1 the forecast is an upper limit of the gain.
    """
    if len(ratios[0]) < 10:
        return ()
    tables = [resolved_log_ratio(ratio, k) for ratio in ratios]
    n_trials = len(tables[0])
    cases = [(n, 1.0) for n in LENSES] + [(1, f) for f in NOISE_FACTORS if f != 1.0]
    forecasts = []
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
        forecasts.append(Forecast(n_lenses, factor, float(median), float(low), float(high), error))
    return tuple(forecasts)


def cold_ratios(
    table: Table, trials: LeaveOneOut, like: LikelihoodRatio, rng: np.random.Generator, n_tables: int = N_TABLES
) -> list[FloatArray]:
    """Return B(m) of the leave-one-out trials with a truth above `CDM_LIKE_KEV`, [n_trials, n_grid] each.

    The first is of the table, the others of `n_tables` bootstrapped tables, all with grid and bandwidth of `like`.
    """
    kernels = BoundaryKernels(like.m_kev, table.m_kev, like.bandwidth_kev, table.m_range_kev)
    accepted = trials.accepted[trials.truth[:, 0] > CDM_LIKE_KEV]
    accepted = accepted[accepted.any(axis=1)]
    times = rng.multinomial(table.n, np.full(table.n, 1.0 / table.n), size=n_tables)
    return [kernels.ratio(accepted), *(kernels.ratio(accepted, row) for row in times)]
