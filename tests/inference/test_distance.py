from __future__ import annotations

import numpy as np
import pytest

from warmlens.inference.distance import correlation_distance, cumulative_distance

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
