from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm, rankdata, truncnorm

from warmlens.inference.acceptance import accept, reduce_distances
from warmlens.inference.bootstrap import bootstrap_counts, quantiles_of_counts
from warmlens.inference.bound import (
    LEVELS,
    TooFewError,
    effective_sample_size,
    lower_bounds,
    weighted_quantile,
)
from warmlens.inference.table import Table

PRIOR = (1.0, 5.0)


def table_of(m, sample_id=None):
    """Only masses: the distances to the observation are passed separately."""
    ids = np.arange(m.size) if sample_id is None else sample_id
    return Table(ids, m, np.full(m.size, 13.2), PRIOR, (13.0, 13.5), (), (), ())


def gaussian_table(n, seed, observed=3.2, sigma=0.5):
    """Two summaries s = m + noise: the posterior is a Gaussian of width sigma / sqrt(2) within the prior."""
    rng = np.random.default_rng(seed)
    m = rng.uniform(*PRIOR, n)
    return m, np.abs(m + rng.normal(0.0, sigma, (2, n)) - observed)


def bounds_of(m, distances, fraction, seed=0, weights=None, n_bootstrap=200):
    acceptance = accept(distances, "max_rank", fraction, np.arange(m.size), np.random.default_rng(seed))
    rng = np.random.default_rng(seed + 1)
    return lower_bounds(table_of(m), acceptance, distances, rng, weights, n_bootstrap)


def test_weighted_quantile_is_that_of_the_step_function():
    values = np.array([3.0, 1.0, 2.0, 4.0])
    weights = np.array([1.0, 2.0, 0.0, 1.0])
    np.testing.assert_array_equal(
        weighted_quantile(values, weights, [0.01, 0.5, 0.51, 0.75, 1.0]), [1, 1, 3, 3, 4]
    )
    hundred = np.arange(1.0, 101.0)
    assert weighted_quantile(hundred, np.full(100, 0.1), 0.05) == 5.0
    np.testing.assert_array_equal(
        weighted_quantile(values, weights, [0.3, 0.6]),
        weighted_quantile(np.array([1.0, 1.0, 3.0, 4.0]), np.ones(4), [0.3, 0.6]),
    )


@pytest.mark.parametrize(("sigma_of_truth", "agrees"), [(0.5, True), (1.0, False)])
def test_posterior_of_the_linear_gaussian_is_found_and_a_wrong_one_is_not(sigma_of_truth, agrees):
    m, distances = gaussian_table(100_000, seed=11)
    result = bounds_of(m, distances, 0.005, n_bootstrap=40)
    width = sigma_of_truth / np.sqrt(2)
    posterior = truncnorm((1.0 - 3.2) / width, (5.0 - 3.2) / width, loc=3.2, scale=width)
    k = result["q05"].k
    assert k == 500
    # in terms of probability, where the error of an empirical quantile is binomial
    off = [
        (posterior.cdf(bound.value_kev) - bound.level) / np.sqrt(bound.level * (1 - bound.level) / k)
        for bound in result.values()
    ]
    assert (np.abs(off) < 3.5).all() == agrees


def test_finite_tolerance_gives_the_box_posterior():
    """At the paper's 5% the tolerance is not small; what ABC then samples is still known exactly."""
    m, distances = gaussian_table(100_000, seed=12)
    acceptance = accept(distances, "max_rank", 0.05, np.arange(m.size), np.random.default_rng(0))
    half_width = distances[:, acceptance.accepted].max(axis=1)
    grid = np.linspace(*PRIOR, 4001)
    inside = [norm.cdf((3.2 + h - grid) / 0.5) - norm.cdf((3.2 - h - grid) / 0.5) for h in half_width]
    cdf = np.cumsum(inside[0] * inside[1])
    exact = np.interp(np.array(list(LEVELS.values())), cdf / cdf[-1], grid)
    bounds = bounds_of(m, distances, 0.05, n_bootstrap=100)
    for bound, value in zip(bounds.values(), exact, strict=True):
        assert abs(bound.value_kev - value) < 3.5 * bound.mc_error_kev
        assert bound.mc_error_kev < 0.03
        assert bound.warnings == ()


def test_uniform_case_is_the_prior_and_says_so():
    rng = np.random.default_rng(13)
    m, distances = rng.uniform(*PRIOR, 2483), rng.random((2, 2483))
    result = bounds_of(m, distances, 0.05, n_bootstrap=1000)
    for bound in result.values():
        assert bound.prior_only_kev == pytest.approx(1.0 + 4.0 * bound.level, abs=0.05)
        assert bound.prior_only_kev == np.sort(m)[int(np.ceil(2483 * bound.level)) - 1]  # of the rows in use
        assert abs(bound.value_kev - bound.prior_only_kev) < 4 * bound.mc_error_kev
        assert any("indistinguishable from the prior" in text for text in bound.warnings)
        assert (bound.k, bound.n, bound.ess) == (124, 2483, 124.0)
    informed = bounds_of(*gaussian_table(2483, seed=13), 0.05)
    assert not any("prior" in text for bound in informed.values() for text in bound.warnings)
    assert any("2.8 samples" in text for text in informed["q02275"].warnings)
    assert (informed["q0455"].k, informed["q0455"].n) == (124, 2483)


def test_monte_carlo_error_is_the_scatter_over_tables():
    results = [bounds_of(*gaussian_table(2000, seed=100 + i), 0.1, seed=i)["q05"] for i in range(40)]
    scatter = np.std([bound.value_kev for bound in results], ddof=1)
    claimed = np.sqrt(np.mean([bound.mc_error_kev**2 for bound in results]))
    assert 0.7 < claimed / scatter < 1.5


def test_bootstrap_is_that_of_explicit_tables():
    rng = np.random.default_rng(14)
    n, fraction, levels = 60, 0.3, np.array([0.05, 0.5])
    m = np.sort(rng.uniform(*PRIOR, n))
    distances = rng.integers(0, 12, (2, n)).astype(float)  # ties between rows
    weights = rng.random(n)
    counts = bootstrap_counts(distances, "max_rank", [fraction, 0.1], 25, np.random.default_rng(15))
    assert (np.sum(counts, axis=2) == np.array([[18], [6]])).all()
    quantiles = quantiles_of_counts(m, counts[0], levels, weights)
    rng = np.random.default_rng(15)
    times, keys = rng.multinomial(n, np.full(n, 1 / n), size=25), rng.random((25, n))
    for row, count, key in zip(quantiles, times, keys, strict=True):
        rows = np.repeat(np.arange(n), count)
        score = rankdata(distances[:, rows], method="max", axis=1).max(axis=0)
        taken = rows[np.lexsort((key[rows], score))[:18]]
        np.testing.assert_array_equal(row, weighted_quantile(m[taken], weights[taken], levels))


def test_only_rows_in_ascending_order_of_their_identity_are_a_table():
    m, _ = gaussian_table(400, seed=16)
    ids = np.arange(400)
    for wrong in (np.random.default_rng(17).permutation(ids), np.where(ids == 3, 2, ids)):
        with pytest.raises(ValueError, match="ascending without repeats"):
            table_of(m, wrong)


def test_weights_change_the_prior():
    m, distances = gaussian_table(20_000, seed=18, observed=1.5, sigma=1.0)
    flat = bounds_of(m, distances, 0.05)["q05"]
    log_uniform = bounds_of(m, distances, 0.05, weights=1.0 / m)["q05"]
    assert log_uniform.value_kev < flat.value_kev
    # uniform in log m: F(m) = ln m / ln 5
    assert log_uniform.prior_only_kev == pytest.approx(5.0**0.05, abs=0.02)
    assert log_uniform.ess < flat.ess == flat.k
    assert effective_sample_size(np.array([1.0, 1.0, 0.0, 0.0])) == 2.0


def test_few_samples_give_a_warning():
    m, distances = gaussian_table(100, seed=19)
    bound = bounds_of(m, distances, 0.1)["q0455"]
    assert any("only 10 samples" in text for text in bound.warnings)
    weights = np.where(np.arange(1000) % 50 == 0, 1.0, 1e-6)
    m, distances = gaussian_table(1000, seed=20)
    weighted = bounds_of(m, distances, 0.2, weights=weights)["q0455"]
    assert any("the weighted samples count as" in text for text in weighted.warnings)


def test_bad_input_is_refused():
    m, distances = gaussian_table(100, seed=21)
    with pytest.raises(ValueError, match="leaves the prior"):
        bounds_of(m + 3.0, distances, 0.1)
    with pytest.raises(ValueError, match="n_bootstrap"):
        bounds_of(m, distances, 0.1, n_bootstrap=1)
    with pytest.raises(ValueError, match="weights must be"):
        bounds_of(m, distances, 0.1, weights=-np.ones(100))
    closest = np.argmin(distances.max(axis=0))
    with pytest.raises(ValueError, match="bootstrapped tables"):
        bounds_of(m, distances, 0.1, weights=(np.arange(100) == closest).astype(float))
    with pytest.raises(ValueError, match="levels"):
        weighted_quantile(m, np.ones(100), 0.0)
    with pytest.raises(ValueError, match="one table"):
        acceptance = accept(distances, "max_rank", 0.1, np.arange(100), np.random.default_rng(0))
        lower_bounds(table_of(m[:50]), acceptance, distances, np.random.default_rng(0))


@pytest.mark.parametrize("rule", ["marginal_and", "scaled_sum", "cumulative"])
def test_bootstrap_of_the_other_rules_is_that_of_explicit_tables(rule):
    rng = np.random.default_rng(22)
    n = 80
    distances = rng.integers(0, 12, (2, n)).astype(float)  # ties between rows
    counts = bootstrap_counts(distances, rule, [0.3], 25, np.random.default_rng(23))[0]
    again = np.random.default_rng(23)
    times = again.multinomial(n, np.full(n, 1 / n), size=25)
    keys = again.random((25, n)) if rule != "marginal_and" else np.zeros((25, n))
    cut_on = reduce_distances(distances, rule)
    for row, count, key in zip(counts, times, keys, strict=True):
        rows = np.repeat(np.arange(n), count)
        if rule == "marginal_and":
            taken = rows[accept(distances[:, rows], rule, 0.3, np.arange(n), rng).accepted]
        else:
            score = rankdata(cut_on[:, rows], method="max", axis=1).max(axis=0)
            taken = rows[np.lexsort((key[rows], score))[:24]]
        np.testing.assert_array_equal(row, np.bincount(taken, minlength=n))


def test_a_bound_of_too_few_marginal_cuts_is_refused_with_its_estimate():
    m, distances = gaussian_table(400, seed=24)
    acceptance = accept(distances, "marginal_and", 0.05, np.arange(400), np.random.default_rng(0))
    assert 0 < acceptance.k < 50
    with pytest.raises(TooFewError, match=r"marginal_and leaves \d+ of 400.*raise abc.fraction = 0.05") as caught:
        lower_bounds(table_of(m), acceptance, distances, np.random.default_rng(0))
    lowest = np.sort(m[acceptance.accepted])
    assert caught.value.estimate == lowest[int(np.ceil(0.0455 * acceptance.k)) - 1]
