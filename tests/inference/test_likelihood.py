from __future__ import annotations

import numpy as np
import pytest

from warmlens.inference.bootstrap import bootstrap_counts
from warmlens.inference.likelihood import BoundaryKernels, crossing, likelihood_ratio, silverman

PRIOR = (1.0, 5.0)


def thinned(likelihood, n, seed):
    """A uniform table, and rows accepted with a probability that is the likelihood."""
    rng = np.random.default_rng(seed)
    m = rng.uniform(*PRIOR, n)
    return m, rng.random(n) < likelihood(m)


@pytest.mark.parametrize(
    "likelihood", [lambda m: np.exp(m - 5.0), lambda m: 1.0 / (1.0 + np.exp(-4.0 * (m - 2.5)))]
)
def test_a_known_likelihood_is_found_to_the_edges(likelihood):
    m, accepted = thinned(likelihood, 200_000, 1)
    counts = np.random.default_rng(2).poisson(accepted, (100, m.size)).astype(np.uint16)
    estimate = likelihood_ratio(m, accepted, counts, PRIOR)
    exact = likelihood(estimate.m_kev) / likelihood(np.array(5.0))
    np.testing.assert_allclose(estimate.ratio, exact, rtol=0.1, atol=0.02)
    for ratio in (0.1, 0.05):
        if exact[0] > ratio:
            continue
        true = np.interp(ratio, exact, estimate.m_kev)
        assert estimate.falls_to(ratio).m_kev == pytest.approx(true, abs=0.12)
    # the naive kernel halves at the edges: the correction is what brings B(1) and B(5) back
    naive = BoundaryKernels(estimate.m_kev, m[accepted], estimate.bandwidth_kev, (-100.0, 100.0))
    assert (
        naive.density(np.ones((1, int(accepted.sum()))))[0, -1] < 0.6 * likelihood(5.0) / likelihood(m).mean() / 4
    )


def test_band_is_the_scatter_over_tables():
    def one(seed):
        rng = np.random.default_rng(seed)
        m = rng.uniform(*PRIOR, 2000)
        distances = np.abs(m + rng.normal(0.0, 0.7, (2, 2000)) - 3.5)
        counts = bootstrap_counts(distances, "max_rank", [0.1], 200, rng)[0]
        accepted = np.zeros(2000, dtype=bool)
        accepted[np.argsort(distances.max(axis=0))[:200]] = True
        return likelihood_ratio(m, accepted, counts, PRIOR)

    estimates = [one(seed) for seed in range(60)]
    at = np.argmin(np.abs(estimates[0].m_kev - 3.0))
    scatter = np.std([np.log(ratio.ratio[at]) for ratio in estimates], ddof=1)
    claimed = np.sqrt(np.mean([np.log(ratio.replicates[:, at]).std() ** 2 for ratio in estimates]))
    assert 0.7 < claimed / scatter < 1.4
    width = np.ptp(estimates[0].band(), axis=0)
    assert width[-1] == 0.0
    assert width[at] > 0.0


def test_crossing_by_hand():
    grid = np.array([1.0, 2.0, 3.0, 4.0])
    ratios = np.array([[0.5, 0.01, 0.1, 1.0], [1.0, 1.0, 1.0, 1.0], [0.001, 0.01, 0.1, 1.0]])
    np.testing.assert_allclose(crossing(grid, ratios, 0.1), [3.0, np.nan, 3.0])
    np.testing.assert_allclose(crossing(grid, ratios, 0.01), [2.0, np.nan, 2.0])
    np.testing.assert_allclose(crossing(grid, ratios[2:], np.sqrt(0.001)), [2.5])


def test_no_data_never_crosses_and_says_so():
    m, accepted = thinned(lambda m: np.full(m.size, 0.2), 2000, 3)
    counts = np.random.default_rng(4).poisson(accepted, (200, m.size)).astype(np.uint16)
    estimate = likelihood_ratio(m, accepted, counts, PRIOR).falls_to(0.1)
    assert estimate.m_kev is None
    assert estimate.fraction_reaching < 0.05
    assert "does not fall to 0.1" in estimate.warnings[0]


def test_a_crossing_on_hardly_any_samples_says_so():
    m = np.linspace(1.0, 5.0, 1000)
    accepted = np.zeros(1000, dtype=bool)
    accepted[600::20] = True
    counts = np.random.default_rng(5).poisson(accepted, (100, 1000)).astype(np.uint16)
    estimate = likelihood_ratio(m, accepted, counts, PRIOR).falls_to(0.05)
    assert estimate.m_kev < 3.4
    assert any("rests on" in text for text in estimate.warnings)


def test_bandwidth_is_that_of_a_normal():
    values = np.random.default_rng(6).normal(3.0, 0.2, 10_000)
    assert silverman(values, PRIOR) == pytest.approx(0.9 * 0.2 * 10_000**-0.2, rel=0.03)
    assert silverman(np.full(10, 3.0), PRIOR) == pytest.approx(0.004)


def test_chance_excesses_of_the_table_cancel():
    m = np.random.default_rng(7).beta(2.0, 2.0, 300) * 4.0 + 1.0  # not uniform at all
    everything = np.ones(300, dtype=bool)
    estimate = likelihood_ratio(m, everything, np.ones((2, 300), dtype=np.uint16), PRIOR)
    np.testing.assert_allclose(estimate.ratio, 1.0, rtol=1e-12)
    np.testing.assert_allclose(estimate.replicates, 1.0, rtol=1e-12)
