"""Likelihood ratio B(m) = p(m | s_o) / pi(m) from accepted samples, independent of the prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # scipy.stats takes 1 s to import; scipy loads it on first use

from warmlens.inference.bootstrap import Counts
from warmlens.inference.memory import row_batches
from warmlens.types import BoolArray, FloatArray, IntArray

RATIOS = (0.1, 0.05)
N_GRID = 81
BAND = (0.16, 0.84)
MIN_EXPECTED = 3.0


@dataclass(frozen=True)
class Crossing:
    """Where the likelihood ratio falls to a value."""

    ratio: float  # 1/10 or 1/20
    # Largest mass at which B has fallen to `ratio` [keV]; None if it does not within the prior
    m_kev: float | None
    # Standard deviation of the mass over those tables [keV]; None if they are less than half of all
    mc_error_kev: float | None
    fraction_reaching: float  # fraction of the bootstrapped tables in which B falls to `ratio`
    warnings: tuple[str, ...]  # what a reader must know before quoting the value


@dataclass(frozen=True)
class LikelihoodRatio:
    """B(m), 1 at the upper end of the prior.

    Attributes
    ----------
    m_kev, ratio
        Grid from edge to edge of the prior [keV] and B on it, each [n_grid].
    replicates
        B of the bootstrapped tables [n_bootstrap, n_grid].
    bandwidth_kev, k
        Standard deviation of the kernel [keV], and number of accepted samples.
    """

    m_kev: FloatArray
    ratio: FloatArray
    replicates: FloatArray
    bandwidth_kev: float
    k: int

    def band(self) -> FloatArray:
        """Return the quantiles `BAND` of the bootstrapped B [2, n_grid]."""
        return np.quantile(self.replicates, BAND, axis=0)

    def falls_to(self, ratio: float) -> Crossing:
        """Return where B falls to `ratio`, coming from the upper end."""
        value = crossing(self.m_kev, self.ratio[None], ratio)[0]
        replicates_kev = crossing(self.m_kev, self.replicates, ratio)
        reaching = np.isfinite(replicates_kev)
        fraction = float(reaching.mean())
        if np.isnan(value):
            return Crossing(ratio, None, None, fraction, (f"B(m) does not fall to {ratio:g} within the prior",))
        warnings = []
        density = self.ratio / np.trapezoid(self.ratio, self.m_kev)
        width = 2.0 * np.sqrt(np.pi) * self.bandwidth_kev  # of the window that averages as many samples
        expected = self.k * float(np.interp(value, self.m_kev, density)) * width
        if expected < MIN_EXPECTED:
            warnings.append(
                f"B = {ratio:g} at {value:.2f} keV rests on {expected:.1f} accepted samples near it "
                f"(fewer than {MIN_EXPECTED:g})"
            )
        error = float(replicates_kev[reaching].std(ddof=1)) if fraction >= 0.5 and reaching.sum() > 1 else None
        if error is None:
            warnings.append(f"B falls to {ratio:g} in {fraction:.0%} of the bootstrapped tables only")
        return Crossing(ratio, float(value), error, fraction, tuple(warnings))


def crossing(grid: FloatArray, ratios: FloatArray, value: float) -> FloatArray:
    """Return the largest mass at which each B of [n, n_grid] is down to `value` [n]; NaN where it never is.

    Linear in log B between the points of the grid.
    """
    below = ratios <= value
    below[:, -1] = False
    reaches = below.any(axis=1)
    last = grid.size - 1 - np.argmax(below[:, ::-1], axis=1)
    last = np.where(reaches, last, 0)
    rows = np.arange(ratios.shape[0])
    tiny = np.finfo(float).tiny
    low, high = np.log(np.maximum(ratios[rows, last], tiny)), np.log(np.maximum(ratios[rows, last + 1], tiny))
    step = np.clip((np.log(value) - low) / np.where(high > low, high - low, 1.0), 0.0, 1.0)
    return np.where(reaches, grid[last] + step * (grid[last + 1] - grid[last]), np.nan)


def likelihood_ratio(
    m_kev: FloatArray,
    accepted: BoolArray,
    counts: Counts,
    m_range_kev: tuple[float, float],
) -> LikelihoodRatio:
    """Estimate B(m) from the accepted samples of a uniform prior.

    The density of the accepted samples is divided by that of all samples with the same kernel, so that chance
    excesses of the table cancel; otherwise they add up when lenses are combined. The bandwidth is Silverman's,
    the same for all bootstrapped tables.

    Parameters
    ----------
    m_kev, accepted
        Relic mass [keV] and acceptance of the samples, each [n].
    counts
        From `bootstrap_counts` [n_bootstrap, n].
    m_range_kev
        Edges of the uniform prior [keV].
    """
    grid = np.linspace(*m_range_kev, N_GRID)
    width = silverman(m_kev[accepted], m_range_kev)
    kernels = BoundaryKernels(grid, m_kev, width, m_range_kev)
    ratio = kernels.ratio(accepted[None])[0]
    replicates = kernels.ratio(counts)
    return LikelihoodRatio(grid, ratio, replicates, width, int(accepted.sum()))


def silverman(values: FloatArray, value_range: tuple[float, float]) -> float:
    """Return Silverman's bandwidth 0.9 min(sd, IQR / 1.34) n^(-1/5), at most a quarter of the range."""
    spread = float(values.std())
    quartiles = np.quantile(values, [0.25, 0.75])
    robust = float(quartiles[1] - quartiles[0]) / 1.34
    width = 0.9 * (min(spread, robust) or spread) * values.size**-0.2
    full = value_range[1] - value_range[0]
    return float(np.clip(width, 1e-3 * full, 0.25 * full))


class BoundaryKernels:
    """Gaussian kernel density within hard edges, corrected there to first order and never negative.

    Reference: Jones 1993, Stat. Comput. 3, 135 (linear boundary kernel); Jones & Foster 1996, Stat. Sinica 6,
    1005 (its positive form f0 exp(f1 / f0 - 1)), as GetDist does (Lewis 2019, sec. 3.2).
    """

    def __init__(
        self, grid: FloatArray, values: FloatArray, bandwidth: float, value_range: tuple[float, float]
    ) -> None:
        lower, upper = (grid - value_range[1]) / bandwidth, (grid - value_range[0]) / bandwidth
        norm = scipy.stats.norm
        a0 = norm.cdf(upper) - norm.cdf(lower)
        a1 = norm.pdf(lower) - norm.pdf(upper)
        a2 = a0 + lower * norm.pdf(lower) - upper * norm.pdf(upper)
        u = (grid[None] - values[:, None]) / bandwidth
        kernel = norm.pdf(u) / bandwidth
        self._constant = kernel / a0
        self._linear = kernel * (a2 - a1 * u) / (a0 * a2 - a1**2)

    def density(self, counts: Counts | BoolArray | IntArray | FloatArray) -> FloatArray:
        """Return the density of every selection [n_selections, n] of the values [n_selections, n_grid]."""
        total = np.maximum(counts.sum(axis=1, keepdims=True), 1)
        constant, linear = np.empty((2, len(counts), self._constant.shape[1]))
        for batch in row_batches(*counts.shape):
            numbers = counts[batch].astype(np.float64)
            constant[batch], linear[batch] = numbers @ self._constant, numbers @ self._linear
        constant, linear = constant / total, linear / total
        safe = np.maximum(constant, np.finfo(float).tiny)
        return constant * np.exp(np.clip(linear / safe - 1.0, -50.0, 50.0))

    def ratio(self, selected: Counts | BoolArray, table: IntArray | None = None) -> FloatArray:
        """Return B of every selection [n_selections, n]: its density over the table's, 1 at the upper end.

        `table` says how often each row is in the table [n]; once by default. The density at the upper end is
        kept above 1e-12 of the largest.
        """
        times = np.ones(selected.shape[1], dtype=np.int64) if table is None else table
        ratios = self.density(selected if table is None else selected * table) / self.density(times[None])
        return ratios / np.maximum(ratios[:, -1:], 1e-12 * ratios.max(axis=1, keepdims=True))
