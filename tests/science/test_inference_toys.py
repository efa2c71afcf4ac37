"""Inference on simulators whose posterior is known exactly; every statement has a wrong twin that breaks it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import kstest, truncnorm

from warmlens.inference.acceptance import RULES, accept
from warmlens.inference.bound import HEADLINE, HEADLINE_INDEX, LEVELS, lower_bounds, weighted_quantile
from warmlens.inference.calibration import LeaveOneOut, coverage, leave_one_out, rank_test
from warmlens.inference.checks import cloud_check
from warmlens.inference.convergence import threshold_convergence
from warmlens.inference.information import information
from warmlens.inference.learned import learned_summaries
from warmlens.inference.table import Table

PRIOR, HALO = (1.0, 5.0), (13.0, 13.5)
SIGMA, HALO_SIGMA = 0.6, 0.1
Noise = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def linear(m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return m + SIGMA * rng.standard_normal(m.size)


def uninformative(m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return 0.02 * m + rng.standard_normal(m.size)


def cubic(m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Sharp, except about 3 keV."""
    return (m - 3.0) ** 3 + 0.1 * rng.standard_normal(m.size)


def folded(m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The same summary on both sides of 2 keV: one line through both branches is wrong."""
    return np.abs(m - 2.0) + 0.05 * rng.standard_normal(m.size)


def toy(n: int, seed: int, summary: Noise = linear, observed: float = 3.4) -> Table:
    """One summary of m, one of the halo mass: the posterior is a product."""
    rng = np.random.default_rng(seed)
    m, log10_mass = rng.uniform(*PRIOR, n), rng.uniform(*HALO, n)
    features = summary(m, rng)[:, None], (log10_mass + HALO_SIGMA * rng.standard_normal(n))[:, None]
    return Table(np.arange(n), m, log10_mass, PRIOR, HALO, features, (np.array([observed]), np.array([13.25])))


def posterior(observed: float) -> truncnorm:
    low, high = (np.array(PRIOR) - observed) / SIGMA
    return truncnorm(low, high, loc=observed, scale=SIGMA)


def accepted_masses(table: Table, fraction: float, rule: str = "max_rank") -> np.ndarray:
    distances = table.distances()
    result = accept(distances, rule, fraction, table.sample_id, np.random.default_rng(0))
    return table.m_kev[result.accepted]


def without_data(table: Table) -> Table:
    """A wrong twin: every sample compares the summaries of another one with the observation."""
    shuffle = np.random.default_rng(99).permutation(table.n)
    return dataclasses.replace(table, features=tuple(rows[shuffle] for rows in table.features))


@pytest.mark.parametrize("observed", [3.4, 5.0, 1.0], ids=["informative", "upper edge", "lower edge"])
def test_the_posterior_is_reached_as_the_threshold_falls(observed: float) -> None:
    table = toy(100_000, 1, observed=observed)
    distance = [
        kstest(accepted_masses(table, fraction, "correlation"), posterior(observed).cdf).statistic
        for fraction in (0.5, 0.1, 0.02, 0.005)
    ]
    assert distance[0] > distance[1]
    assert distance[-1] < 1.63 / np.sqrt(500)  # the 1% point of the statistic for 500 samples
    assert distance[0] > 0.09
    twin = accepted_masses(without_data(table), 0.005, "correlation")
    assert kstest(twin, posterior(observed).cdf).statistic > 0.2


@pytest.mark.parametrize("rule", RULES)
def test_every_rule_that_looks_at_this_summary_finds_it(rule: str) -> None:
    masses = accepted_masses(toy(100_000, 2), 0.1 if rule == "marginal_and" else 0.01, rule)
    statistic = kstest(masses, posterior(3.4).cdf).statistic
    if rule == "cumulative":  # that one tells of the halo mass alone
        assert kstest(masses, "uniform", args=(1.0, 4.0)).pvalue > 0.01
        assert statistic > 0.2
    else:
        assert statistic < 0.06


def test_without_information_the_posterior_is_the_prior() -> None:
    table = toy(20_000, 3, uninformative, observed=0.1)
    assert kstest(accepted_masses(table, 0.05), "uniform", args=(1.0, 4.0)).pvalue > 0.01


def test_other_priors_enter_once() -> None:
    table, observed = toy(100_000, 4, observed=1.8), 1.8
    near = accept(table.distances(), "max_rank", 0.01, table.sample_id, np.random.default_rng(0)).accepted
    m = table.m_kev[near]
    grid = np.linspace(*PRIOR, 4001)
    levels = np.array([0.1, 0.25, 0.5])

    def exact(power: int) -> np.ndarray:
        cdf = np.cumsum(posterior(observed).pdf(grid) * grid**-power)
        return np.interp(levels, cdf / cdf[-1], grid)

    np.testing.assert_allclose(weighted_quantile(m, m**-2.0, levels), exact(2), atol=0.06)
    twice = weighted_quantile(m, m**-4.0, levels)  # a wrong twin
    assert np.abs(twice - exact(2)).max() > 0.15


def calibrated(trials: LeaveOneOut, adjusted: bool = False) -> bool:
    """Coverage nominal within Clopper-Pearson, and flat ranks of m."""
    bounds = trials.adjusted_bounds if adjusted else trials.bounds
    pit = trials.adjusted_pit if adjusted else trials.pit
    assert bounds is not None
    assert pit is not None
    covered = coverage(bounds[:, HEADLINE_INDEX], trials.truth[:, 0], LEVELS[HEADLINE])
    return covered.nominal_inside and rank_test(pit[:, 0], np.random.default_rng(0)).ks_p > 0.01


@pytest.mark.parametrize("summary", [linear, uninformative])
def test_coverage_is_nominal_and_ranks_are_flat(summary: Noise) -> None:
    table = toy(3000, 5, summary)
    trials = leave_one_out(table, "max_rank", 0.05, 800, np.random.default_rng(0), with_adjustment=True)
    assert calibrated(trials)
    assert calibrated(trials, adjusted=True)
    for parameter in (0, 1):
        assert rank_test(trials.pit[:, parameter], np.random.default_rng(1)).ks_p > 0.01
    assert not trials.accepted[np.arange(800), trials.rows].any()


def test_wrong_twins_of_leave_one_out_are_found() -> None:
    table = toy(2000, 6)
    rng = np.random.default_rng(0)
    right = leave_one_out(table, "correlation", 0.01, 800, rng)
    assert rank_test(right.pit[:, 0], rng).ks_p > 0.01
    # the truth of the next row
    shifted = dataclasses.replace(table, m_kev=np.roll(table.m_kev, 1), log10_mass=np.roll(table.log10_mass, 1))
    of_next = leave_one_out(table, "correlation", 0.01, 800, np.random.default_rng(0))
    truth = shifted.m_kev[of_next.rows]
    ranks = np.array([np.mean(table.m_kev[row] < m) for row, m in zip(of_next.accepted, truth, strict=True)])
    assert kstest(ranks, "uniform").pvalue < 1e-6
    # the row itself left in: each has a double, which is accepted with it
    double = Table(
        np.arange(1000),
        np.repeat(table.m_kev[:500], 2),
        np.repeat(table.log10_mass[:500], 2),
        PRIOR,
        HALO,
        tuple(np.repeat(rows[:500], 2, axis=0) for rows in table.features),
        table.observed,
    )
    left_in = leave_one_out(double, "correlation", 0.005, 800, np.random.default_rng(0))
    five = leave_one_out(table, "correlation", 0.0025, 800, np.random.default_rng(0))
    assert five.accepted.sum(axis=1).max() == left_in.accepted.sum(axis=1).max() == 5
    # the lowest of five: one more sample lies below it with probability 1/6, itself never
    assert coverage(five.bounds[:, HEADLINE_INDEX], five.truth[:, 0], 1 / 6).nominal_inside
    assert not coverage(left_in.bounds[:, HEADLINE_INDEX], left_in.truth[:, 0], 1 / 6).nominal_inside


def test_the_adjustment_helps_where_it_should_and_is_flagged_where_it_should_not() -> None:
    rng = np.random.default_rng(0)
    wide = leave_one_out(toy(2000, 7, cubic), "correlation", 0.1, 600, rng, with_adjustment=True)
    assert not calibrated(wide)  # 10% is too much without it
    assert calibrated(wide, adjusted=True)
    fold = leave_one_out(toy(2000, 7, folded), "correlation", 0.3, 600, rng, with_adjustment=True)
    assert not calibrated(fold, adjusted=True)


def test_monte_carlo_error_is_the_scatter_over_independent_tables() -> None:
    bounds = []
    for seed in range(300):
        table = toy(1500, 1000 + seed)
        distances = table.distances()
        rng = np.random.default_rng(seed)
        result = accept(distances, "max_rank", 0.1, table.sample_id, rng)
        bound = lower_bounds(table, result, distances, rng, n_bootstrap=150)[HEADLINE]
        bounds.append((bound.value_kev, bound.mc_error_kev))
    values, errors = np.array(bounds).T
    assert 0.8 < errors.mean() / values.std(ddof=1) < 1.2


@pytest.mark.parametrize("cross_fitted", [True, False])
def test_learned_summaries_keep_the_calibration_honest(cross_fitted: bool) -> None:
    """Few samples, many summaries, little signal: only predictions of models that saw a sample look good."""
    rng = np.random.default_rng(11)
    n, p = 1000, 250
    base = toy(n, 11)
    everything = rng.standard_normal((n, p))
    everything[:, 0] += 0.5 * base.m_kev
    if cross_fitted:
        learned = learned_summaries(base.parameters, everything, everything[0], rng).samples
    else:  # a wrong twin
        design = np.column_stack([np.ones(n), everything])
        learned = design @ np.linalg.lstsq(design, base.parameters, rcond=None)[0]
    features = learned[:, [0]], learned[:, [1]]
    table = dataclasses.replace(base, features=features, observed=tuple(rows[0] for rows in features))
    trials = leave_one_out(table, "max_rank", 0.1, 600, rng)
    gain = information(table.m_kev, PRIOR, trials, rng)
    fair = leave_one_out(
        dataclasses.replace(table, features=(everything[:, :1], features[1])), "correlation", 0.1, 600, rng
    )
    best = information(table.m_kev, PRIOR, fair, rng)  # what the one summary that tells has to say
    if cross_fitted:
        assert calibrated(trials)
    assert (gain.gain_nats < best.gain_nats + 2.0 * best.gain_error_nats) == cross_fitted


def test_threshold_convergence_is_reported_only_when_it_is_there() -> None:
    def verdicts(table: Table, fraction: float, fractions: tuple[float, ...]) -> tuple[str, str]:
        convergence, counts = threshold_convergence(
            table, "correlation", fraction, 200, np.random.default_rng(1), fractions
        )
        assert counts.shape == (200, table.n)
        descending = sorted(fractions, reverse=True)
        assert [step.k for step in convergence.steps] == [round(f * table.n) for f in descending]
        return convergence.raw, convergence.adjusted

    assert verdicts(toy(20_000, 8), 0.02, (0.04, 0.02, 0.01))[0] == "converged"
    assert verdicts(toy(20_000, 8), 0.6, (0.9, 0.6, 0.4, 0.2))[0] == "not converged"
    assert verdicts(toy(500, 8), 0.05, (0.1, 0.05, 0.02))[0] == "too few samples to tell"


def test_information_is_that_of_the_simulator() -> None:
    rng = np.random.default_rng(2)
    gains = {}
    for summary in (linear, uninformative):
        table = toy(4000, 9, summary)
        trials = leave_one_out(table, "correlation", 0.03, 400, rng)
        gains[summary] = information(table.m_kev, PRIOR, trials, rng)
    # mutual information of m and s: entropy of s less that of its noise
    grid = np.linspace(-2.0, 8.0, 4001)
    s = np.array([np.mean(posterior_density(g)) for g in grid])
    exact = -np.trapezoid(s * np.log(np.maximum(s, 1e-300)), grid) - 0.5 * np.log(2 * np.pi * np.e * SIGMA**2)
    assert gains[linear].gain_nats == pytest.approx(exact, abs=0.08)
    assert abs(gains[uninformative].gain_nats) < 4 * gains[uninformative].gain_error_nats
    assert gains[linear].expected_bound_kev > 3.0
    assert gains[uninformative].expected_bound_kev == pytest.approx(1.18, abs=0.08)


def posterior_density(s: float) -> np.ndarray:
    m = np.linspace(*PRIOR, 400)
    return np.exp(-0.5 * ((s - m) / SIGMA) ** 2) / np.sqrt(2.0 * np.pi) / SIGMA


def test_an_observation_outside_the_samples_gives_a_warning() -> None:
    table = toy(2000, 10)
    assert cloud_check(table).outside == ()
    outside = dataclasses.replace(table, observed=(np.array([12.0]), table.observed[1]))
    check = cloud_check(outside)
    assert check.percentile["correlation"] > 99.0
    assert "THE OBSERVATION LIES OUTSIDE THE SIMULATIONS in correlation" in check.outside[0]
