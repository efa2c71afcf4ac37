from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from warmlens.inference.bound import LEVELS
from warmlens.inference.calibration import leave_one_out
from warmlens.inference.combine import (
    cold_ratios,
    combine,
    forecast,
    posterior_quantiles,
    resolved_log_ratio,
)
from warmlens.inference.likelihood import LikelihoodRatio, likelihood_ratio
from warmlens.inference.table import Table

GRID = np.linspace(1.0, 5.0, 201)


def lens(log_ratio, k=10**9, grid=GRID, scatter=0.0):
    noise = scatter * np.random.default_rng(1).standard_normal((50, 1)) * (grid - grid[-1])
    ratio = np.exp(log_ratio - log_ratio[-1])
    return LikelihoodRatio(grid, ratio, ratio * np.exp(noise), 0.2, k)


def gaussian(mean, sigma, grid=GRID):
    return lens(norm.logpdf(grid, mean, sigma), grid=grid)


def test_likelihoods_multiply_and_the_prior_counts_once():
    first, second = gaussian(3.0, 0.8), gaussian(4.0, 0.6)
    combined = combine([first, second])
    weights = np.array([0.8, 0.6]) ** -2
    mean, sigma = (weights * [3.0, 4.0]).sum() / weights.sum(), weights.sum() ** -0.5
    low, high = norm.cdf([1.0, 5.0], mean, sigma)
    for name, level in LEVELS.items():
        exact = norm.ppf(low + level * (high - low), mean, sigma)
        assert combined.bounds_kev[name] == pytest.approx(exact, abs=2e-3)
        assert combined.prior_only_kev[name] == pytest.approx(1.0 + 4.0 * level)
    # lenses that say nothing leave the prior as it is, however many
    flat = combine([lens(np.zeros(201))] * 10)
    assert flat.bounds_kev["q05"] == pytest.approx(1.2)
    assert flat.falls_to(0.1) is None
    # the wrong twin multiplies posteriors of a prior 1 / m: it narrows without any data
    twin = combine([lens(-np.log(GRID))] * 10)
    assert twin.bounds_kev["q05"] < 1.02


def test_one_lens_is_itself_and_the_order_has_no_say():
    one, two, three = gaussian(3.0, 0.8), gaussian(4.0, 0.6), lens(0.5 * GRID, scatter=0.2)
    np.testing.assert_allclose(combine([one]).ratio, one.ratio, rtol=1e-12)
    first, second = combine([one, two, three]), combine([three, one, two])
    np.testing.assert_allclose(first.ratio, second.ratio, rtol=1e-9)
    assert first.mc_errors_kev["q05"] > 0.0


def test_different_ranges_meet_where_all_are():
    other = gaussian(3.5, 0.7, np.linspace(2.0, 8.0, 121))
    combined = combine([gaussian(3.0, 0.8), other])
    assert (combined.m_kev[0], combined.m_kev[-1]) == (2.0, 5.0)
    with pytest.raises(ValueError, match="no relic mass in common: up to 5 keV and from 6 keV"):
        combine([gaussian(3.0, 0.8), gaussian(7.0, 0.5, np.linspace(6.0, 9.0, 11))])


def test_no_lens_excludes_more_than_its_samples_show():
    steep = lens(20.0 * GRID, k=100)
    assert np.exp(resolved_log_ratio(steep.ratio, 100)).min() == pytest.approx(0.01)
    assert combine([steep]).ratio.min() == pytest.approx(0.01)
    assert combine([steep, steep]).ratio.min() == pytest.approx(1e-4)


def test_quantiles_of_a_known_density():
    log_ratio = np.stack([np.zeros(201), np.log(np.maximum(GRID - 1.0, 1e-300))])
    quantiles = posterior_quantiles(GRID, log_ratio, np.array([0.04, 0.25]))
    np.testing.assert_allclose(quantiles, [[1.16, 2.0], [1.8, 3.0]], atol=2e-3)


def test_forecast_for_gaussian_lenses():
    """Lenses that measure m with an error sigma: n of them with sigma / sqrt(n)."""
    rng = np.random.default_rng(2)
    truth = rng.uniform(1.0, 5.0, 4000)
    sigma = 1.5
    measured = truth + sigma * rng.standard_normal(4000)
    ratios = np.exp(norm.logpdf(GRID, measured[:, None], sigma) - norm.logpdf(GRID[-1:], measured[:, None], sigma))
    cold = ratios[truth > 4.5]
    forecasts = forecast(GRID, [cold] * 10, 10**9, 0.0455, rng)
    by_number = {entry.n_lenses: entry for entry in forecasts if entry.noise_factor == 1.0}
    by_noise = {entry.noise_factor: entry for entry in forecasts if entry.n_lenses == 1}
    medians = [by_number[n].median_kev for n in sorted(by_number)]
    assert (np.diff(medians) > 0.0).all()
    assert by_noise[2.0].median_kev < by_noise[1.0].median_kev < by_noise[0.5].median_kev
    quarter = forecast(GRID, [cold**0.25] * 10, 10**9, 0.0455, rng)[0]
    assert by_noise[2.0].median_kev == pytest.approx(quarter.median_kev, abs=0.03)
    # 16 lenses: 4.75 +- 0.375, cut off at 5
    expected = np.median(
        [
            posterior_quantiles(GRID, norm.logpdf(GRID[None], 4.75 + 0.375 * z, 0.375), np.array([0.0455]))[0, 0]
            for z in rng.standard_normal(200)
        ]
    )
    assert by_number[16].median_kev == pytest.approx(expected, abs=0.1)
    assert 0.0 < by_number[1].median_error_kev < 0.2
    assert forecast(GRID, [ratios[:5]], 100, 0.0455, rng) == ()


def test_many_lenses_without_information_are_still_the_prior_within_the_error():
    rng = np.random.default_rng(3)
    n = 2000
    table = Table(
        np.arange(n),
        rng.uniform(1.0, 5.0, n),
        rng.uniform(13.0, 13.5, n),
        (1.0, 5.0),
        (13.0, 13.5),
        (rng.standard_normal((n, 1)), rng.standard_normal((n, 1))),
        (np.zeros(1), np.zeros(1)),
    )
    trials = leave_one_out(table, "max_rank", 0.05, 600, rng)
    accepted = trials.accepted[0]
    like = likelihood_ratio(table.m_kev, accepted, accepted[None].astype(np.uint16), (1.0, 5.0))
    forecasts = forecast(like.m_kev, cold_ratios(table, trials, like, rng), 100, 0.0455, rng)
    for case in forecasts:
        assert abs(case.median_kev - 1.182) < max(4.0 * case.median_error_kev, 0.03), case
    assert forecasts[0].median_error_kev < 0.03
    assert forecasts[5].median_error_kev > forecasts[0].median_error_kev
