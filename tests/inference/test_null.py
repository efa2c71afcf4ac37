from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from warmlens.inference.acceptance import accept
from warmlens.inference.bound import LEVELS, weighted_quantile
from warmlens.inference.checks import cloud_check, rank_among
from warmlens.inference.null import null_test
from warmlens.inference.table import Table

LEVEL = np.array(list(LEVELS.values()))


@pytest.fixture(scope="module")
def table() -> Table:
    rng = np.random.default_rng(1)
    m, log10_mass = rng.uniform(1.0, 5.0, 600), rng.uniform(13.0, 13.5, 600)
    first = m[:, None] + 0.3 * rng.standard_normal((600, 2))
    second = log10_mass[:, None] + 0.1 * rng.standard_normal((600, 1))
    observed = np.array([4.0, 4.0]), np.array([13.2])
    return Table(np.arange(600), m, log10_mass, (1.0, 5.0), (13.0, 13.5), (first, second), observed)


def run(table: Table, *points: np.ndarray, rule: str = "max_rank", fraction: float = 0.1):
    return null_test(table, points, cloud_check(table), rule, fraction, np.random.default_rng(0))


def test_every_mock_goes_through_the_procedure_of_the_observation(table: Table) -> None:
    points = np.array([[1.1, 1.2], [4.0, 4.0], [3.0, 2.5]]), np.array([[13.3], [13.2], [13.1]])
    test = run(table, *points)
    for i in range(3):
        as_observed = dataclasses.replace(table, observed=tuple(rows[i] for rows in points))
        distances = as_observed.distances()
        chosen = accept(distances, "max_rank", 0.1, table.sample_id, np.random.default_rng(0)).accepted
        np.testing.assert_array_equal(test.accepted[i], chosen)
        expected = weighted_quantile(table.m_kev[chosen], np.ones(60), LEVEL)
        np.testing.assert_array_equal(test.bounds[i], expected)
        percentile = cloud_check(as_observed).percentile
        np.testing.assert_allclose(test.nearest_percentile[:, i], list(percentile.values()))
    assert test.bounds[0, 1] < 1.3 < 2.5 < test.bounds[1, 1]
    np.testing.assert_allclose(test.quantiles_kev, np.quantile(test.bounds[:, 1], [0.16, 0.5, 0.84]))
    assert test.fraction_reaching(test.bounds[1, 1]) == pytest.approx(1 / 3)
    assert test.fraction_reaching(4.9) == 0.0


def test_mocks_outside_the_samples_are_told_from_those_inside(table: Table) -> None:
    test = run(table, np.array([[3.0, 3.0], [30.0, 3.0]]), np.array([[13.2], [13.2]]))
    assert test.nearest_percentile[0, 0] < 95.0
    assert test.nearest_percentile[0, 1] == 100.0


def test_a_mock_for_which_nothing_is_accepted_has_no_bound(table: Table) -> None:
    """The halo mass of the heaviest and the summary of the warmest: no sample is near in both."""
    tight = dataclasses.replace(table, features=(table.features[0], -table.features[0][:, :1]))
    test = run(tight, np.array([[1.0, 1.0]]), np.array([[-5.0]]), rule="marginal_and", fraction=0.02)
    assert np.isnan(test.bounds).all()
    assert test.fraction_reaching(1.0) == 0.0


def test_ranks_by_hand() -> None:
    values = np.array([1.0, 2.0, 2.0, 3.0])
    inside, low, high, tied = (rank_among(values, x) for x in (2.5, 0.0, 9.0, 2.0))
    assert (inside.rank, inside.p_value, inside.n) == (0.75, 0.8, 4)
    assert (low.rank, low.p_value) == (0.0, 0.4)
    assert (high.rank, high.p_value) == (1.0, 0.4)
    assert (tied.rank, tied.p_value) == (0.5, 1.0)


def test_p_values_of_ranks_are_uniform_or_careful() -> None:
    rng = np.random.default_rng(0)
    p = np.array([rank_among(rng.random(39), rng.random()).p_value for _ in range(4000)])
    for level in (0.05, 0.1, 0.5):
        assert np.mean(p <= level) == pytest.approx(level, abs=0.02)
    ties = np.array([rank_among(rng.integers(0, 3, 39), rng.integers(0, 3)).p_value for _ in range(500)])
    assert (ties > 0.05).all()
