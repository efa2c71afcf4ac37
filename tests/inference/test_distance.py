from __future__ import annotations

import numpy as np
import pytest

from warmlens.inference.distance import (
    correlation_distance,
    cumulative_distance,
    integral_features,
    ledoit_wolf,
    squared_distances,
    whitening,
)

DR = np.linspace(0.0, 2.5, 51)


def test_integrals_that_are_known():
    constant = correlation_distance(DR, np.full(51, 3.0), np.full(51, 1.0))
    assert constant == pytest.approx(4.0 * 2.5)
    first = np.stack([np.zeros(51), 2.0 * np.sqrt(DR), np.sqrt(DR)])
    np.testing.assert_allclose(correlation_distance(DR, first, np.zeros(51)), [0.0, 4.0 * 3.125, 3.125])
    grid = np.array([-40.0, -20.0, -4.0])  # uneven: 0.5 * 20 * (0 + 1) + 0.5 * 16 * (1 + 4)
    distance = cumulative_distance(grid, np.array([0.0, 1.0, 2.0]), np.zeros(3))
    assert distance == pytest.approx(50.0)


def test_distance_is_symmetric_and_broadcasts():
    rng = np.random.default_rng(0)
    first, second = rng.random((2, 4, 51))
    matrix = correlation_distance(DR, first[:, None], second[None])
    assert matrix.shape == (4, 4)
    assert matrix[1, 2] == correlation_distance(DR, second[2], first[1])


@pytest.mark.parametrize("distance", [correlation_distance, cumulative_distance])
def test_what_is_not_finite_is_refused(distance):
    first = np.zeros((3, 51))
    first[1, 7] = np.nan
    with pytest.raises(ValueError, match="not finite in 1"):
        distance(DR, first, np.zeros(51))
    with pytest.raises(ValueError, match="second"):
        distance(DR, np.zeros(51), np.full(51, np.inf))


def test_wrong_grids_are_refused():
    with pytest.raises(ValueError, match="ascending"):
        correlation_distance(DR[::-1], np.zeros(51), np.zeros(51))
    with pytest.raises(ValueError, match="first correlation function has shape"):
        correlation_distance(DR, np.zeros(50), np.zeros(51))


def test_points_have_the_distance_of_the_integrals():
    rng = np.random.default_rng(1)
    grid = np.sort(rng.random(20))
    first, second = rng.random((5, 20)), rng.random((4, 20))
    squared = squared_distances(integral_features(grid, first), integral_features(grid, second))
    np.testing.assert_allclose(squared, correlation_distance(grid, first[:, None], second[None]), rtol=1e-12)


def test_shrunk_covariance_is_that_of_an_independent_code():
    sklearn = pytest.importorskip("sklearn.covariance")
    rows = np.random.default_rng(2).standard_normal((40, 25)) @ np.diag(np.linspace(0.5, 3.0, 25)) + 7.0
    covariance, shrinkage = ledoit_wolf(rows)
    expected, intensity = sklearn.ledoit_wolf(rows)
    np.testing.assert_allclose(covariance, expected, rtol=1e-10, atol=1e-12)
    assert shrinkage == pytest.approx(intensity)
    assert 0.0 < shrinkage < 1.0


def test_whitening_is_without_scale_and_correlation():
    rng = np.random.default_rng(3)
    mixing = rng.random((6, 6))
    rows, observed = rng.standard_normal((5000, 6)) @ mixing, rng.standard_normal(6) @ mixing
    white, white_observed = (whitening(rows, observed)(values) for values in (rows, observed))
    np.testing.assert_allclose(np.cov(white.T), np.eye(6), atol=0.25)
    units = np.array([1e6, 1, 1, 1e-6, 1, 1])
    scaled, scaled_observed = (whitening(rows * units, observed * units)(v * units) for v in (rows, observed))
    np.testing.assert_allclose(
        squared_distances(white_observed[None], white), squared_distances(scaled_observed[None], scaled), rtol=1e-6
    )
    constant = np.column_stack([rows, np.zeros(5000)])

    def whitened(target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        change = whitening(constant, target)
        return change(constant), change(target)

    again, again_observed = whitened(np.append(observed, 0.0))
    assert again.shape == (5000, 6)
    outlier, outlier_observed = whitened(np.append(observed, 9.0))
    assert (
        squared_distances(outlier_observed[None], outlier).min()
        > squared_distances(again_observed[None], again).min()
    )
