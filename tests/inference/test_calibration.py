from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from warmlens.inference.acceptance import accept
from warmlens.inference.adjustment import adjust, adjusted_quantiles_of_counts, kernel_weights, local_scores
from warmlens.inference.bootstrap import bootstrap_counts
from warmlens.inference.bound import LEVELS, TooFewError, weighted_quantile
from warmlens.inference.calibration import (
    clopper_pearson,
    coverage,
    coverage_by_mass,
    expected_limit,
    leave_one_out,
    rank_test,
)
from warmlens.inference.checks import cloud_check, posterior_predictive
from warmlens.inference.distance import squared_distances
from warmlens.inference.table import Table

LEVEL = np.array(list(LEVELS.values()))


def table(n=400, seed=1, sigma=0.5, p=6, observed=3.0):
    rng = np.random.default_rng(seed)
    m, log10_mass = rng.uniform(1.0, 5.0, n), rng.uniform(13.0, 13.5, n)
    first = m[:, None] + sigma * rng.standard_normal((n, p))
    second = log10_mass[:, None] + 0.2 * rng.standard_normal((n, 3))
    return Table(
        np.arange(n),
        m,
        log10_mass,
        (1.0, 5.0),
        (13.0, 13.5),
        (first, second),
        (np.full(p, observed), np.full(3, 13.2)),
    )


def test_leave_one_out_is_the_procedure_on_the_table_without_the_row():
    samples = table()
    trials = leave_one_out(samples, "max_rank", 0.3, 30, np.random.default_rng(0), with_adjustment=True)
    for i, row in enumerate(trials.rows):
        rest = np.delete(np.arange(samples.n), row)
        distances = np.array([squared_distances(f[[row]], f[rest])[0] for f in samples.features])
        result = accept(distances, "max_rank", 0.3, rest, np.random.default_rng(7))
        if result.n_tied == 0:
            np.testing.assert_array_equal(np.flatnonzero(trials.accepted[i]), rest[result.accepted])
            quantiles = weighted_quantile(samples.m_kev[rest[result.accepted]], np.ones(result.k), LEVEL)
            np.testing.assert_array_equal(trials.bounds[i], quantiles)
            below = (samples.m_kev[rest[result.accepted]] < samples.m_kev[row]).sum()
            assert 0.0 <= trials.pit[i, 0] * (result.k + 1) - below <= 1.0
    np.testing.assert_array_equal(trials.truth, samples.parameters[trials.rows])
    assert not trials.accepted[np.arange(30), trials.rows].any()
    every = leave_one_out(samples, "cumulative", 0.02, samples.n, np.random.default_rng(0)).pit
    assert ((every > 0.0) & (every < 1.0)).all()  # below and above all accepted ones there is a step too
    assert np.unique(every[:, 0]).size == samples.n
    assert trials.adjusted_bounds.shape == (30, 3)
    few = leave_one_out(samples, "max_rank", 0.1, 30, np.random.default_rng(0), with_adjustment=True)
    assert few.adjusted_bounds is None


def test_rows_without_any_accepted_sample_have_no_bound():
    trials = leave_one_out(table(60), "marginal_and", 0.05, 60, np.random.default_rng(0))
    empty = ~trials.accepted.any(axis=1)
    assert empty.any()
    np.testing.assert_array_equal(np.isnan(trials.bounds[:, 0]), empty)
    assert coverage(trials.bounds[:, 0], trials.truth[:, 0], 0.05).n == (~empty).sum()


def test_clopper_pearson_is_its_definition():
    low, high = clopper_pearson(7, 20)
    assert binom.sf(6, 20, low) == pytest.approx(0.025)
    assert binom.cdf(7, 20, high) == pytest.approx(0.025)
    assert clopper_pearson(0, 10)[0] == 0.0
    assert clopper_pearson(10, 10)[1] == 1.0


def test_coverage_counts_truths_above_the_bound():
    truth = np.array([1.5, 1.9, 2.5, 4.0, 4.5])
    covered = coverage(np.array([1.0, 2.0, 2.5, 4.5, np.nan]), truth, 0.05)
    assert (covered.n, covered.n_covered, covered.fraction) == (4, 2, 0.5)
    assert not covered.nominal_inside
    by_mass = coverage_by_mass(np.ones(5), truth, 0.05)
    assert [by_mass[name].n for name in by_mass] == [2, 1, 2]


def test_rank_test_knows_uniform_from_not():
    rng = np.random.default_rng(2)
    outside = [not rank_test(rng.random(400), rng, n_simulated=500).inside_band for _ in range(200)]
    assert 0.01 < np.mean(outside) < 0.12
    bad = rank_test(rng.beta(0.7, 0.7, 800), rng)
    assert not bad.inside_band
    assert bad.ks_p < 0.01


def test_expected_limit_is_that_of_cdm_like_truths():
    truth = np.linspace(1.0, 5.0, 401)
    limit = expected_limit(truth - 1.0, truth, 3.75, np.random.default_rng(3))
    assert limit.n == 50
    assert limit.quantiles_kev[2] == pytest.approx(3.755)
    assert limit.observed_percentile == pytest.approx(50.0, abs=2.0)
    assert expected_limit(truth[:20], truth[:20], 1.0, np.random.default_rng(3)) is None


def test_epanechnikov_weights_fall_to_zero_at_the_cut():
    distances = np.array([[0.0, 1.0, 2.0, 9.0], [0.0, 0.0, 3.0, 0.0]])
    accepted = np.array([True, True, True, False])
    np.testing.assert_allclose(kernel_weights(distances, accepted), [1.0, 0.5, 0.0])
    np.testing.assert_allclose(kernel_weights(np.zeros((2, 4)), accepted), 1.0)


def test_adjustment_removes_what_is_linear():
    """Without noise the adjusted samples all stand at the truth, the accepted ones spread by the tolerance."""
    rng = np.random.default_rng(4)
    theta = rng.uniform(0.0, 1.0, (1000, 1))
    line = np.log(theta / (1.0 - theta))
    features = line * np.array([[1.0, 2.0]])
    observed = np.array([0.3, 0.6])
    distances = squared_distances(observed[None], features)
    accepted = accept(distances, "max_rank", 0.3, np.arange(1000), rng).accepted
    moved = adjust(theta, [(0.0, 1.0)], features, observed, distances, accepted)
    assert moved.values.std() < 0.01 * theta[accepted].std()
    assert moved.values.mean() == pytest.approx(1.0 / (1.0 + np.exp(-0.3)), abs=1e-3)
    assert moved.n_components == 1


def test_adjustment_stays_within_the_prior_and_does_nothing_without_information():
    rng = np.random.default_rng(5)
    theta = rng.uniform(1.0, 5.0, (4000, 1))
    features = rng.standard_normal((4000, 4))
    distances = squared_distances(np.zeros((1, 4)), features)
    accepted = accept(distances, "max_rank", 0.2, np.arange(4000), rng).accepted
    moved = adjust(theta, [(1.0, 5.0)], features, np.zeros(4), distances, accepted)
    assert moved.values.min() > 1.0
    assert moved.values.max() < 5.0
    assert np.std(moved.values - theta[accepted]) < 0.25
    assert np.std(moved.values) == pytest.approx(4.0 / np.sqrt(12.0), rel=0.05)
    constant = adjust(theta, [(1.0, 5.0)], np.zeros((4000, 4)), np.zeros(4), distances, accepted)
    assert constant.n_components == 0
    with pytest.raises(TooFewError, match=r"needs 100 accepted samples, there are 40; raise abc\.fraction"):
        few = accept(distances, "max_rank", 0.01, np.arange(4000), rng).accepted
        adjust(theta, [(1.0, 5.0)], features, np.zeros(4), distances, few)


def test_bootstrapped_adjustment_is_that_of_each_table():
    samples = table(500, 6)
    distances, features = samples.distances(), samples.stacked()
    observed = np.concatenate(samples.observed)
    accepted = accept(distances, "max_rank", 0.3, samples.sample_id, np.random.default_rng(0)).accepted
    scores = local_scores(features, features[accepted], observed)
    quantiles = adjusted_quantiles_of_counts(
        samples.m_kev, (1.0, 5.0), scores, distances, accepted[None].astype(np.uint16), LEVEL
    )
    moved = adjust(samples.parameters, samples.ranges, features, observed, distances, accepted)
    expected = weighted_quantile(moved.values[:, 0], moved.weights, LEVEL)
    np.testing.assert_allclose(quantiles[0], expected, rtol=1e-9)
    counts = bootstrap_counts(distances, "max_rank", [0.3], 50, np.random.default_rng(1))[0]
    spread = adjusted_quantiles_of_counts(samples.m_kev, (1.0, 5.0), scores, distances, counts, LEVEL)
    assert spread.shape == (50, 3)
    assert 0.005 < spread[:, 1].std() < 0.3


def test_summaries_that_are_all_alike_are_named():
    samples = table()
    dead = Table(
        samples.sample_id,
        samples.m_kev,
        samples.log10_mass,
        samples.m_range_kev,
        samples.log10_mass_range,
        (np.zeros((samples.n, 4)), samples.features[1]),
        (np.zeros(4), samples.observed[1]),
    )
    check = cloud_check(dead)
    assert check.outside == ()
    (text,) = check.uninformative
    assert text == "all samples have the same distance in correlation: it tells nothing about them"
    assert check.percentile["correlation"] == 50.0


def test_posterior_predictive():
    samples = table()
    accepted = np.abs(samples.m_kev - 3.0) < 0.3
    inside = posterior_predictive(samples.features[0], np.full(6, 3.0), accepted)
    assert inside.quantiles.shape == (5, 6)
    assert (np.diff(inside.quantiles, axis=0) > 0.0).all()
    assert inside.p_value > 0.2
    assert posterior_predictive(samples.features[0], np.full(6, 7.0), accepted).p_value < 0.05
    values = [
        posterior_predictive(samples.features[0], samples.features[0][row], accepted).p_value
        for row in np.flatnonzero(accepted)
    ]
    assert 0.3 < np.mean(values) < 0.7
