from __future__ import annotations

import numpy as np
import pytest

from warmlens.summaries.correlation import PairGeometry
from warmlens.summaries.response import amplitude_correlation, mean_square_significance


def maps(seed=1, shape=(3, 14, 11)):
    rng = np.random.default_rng(seed)
    valid = rng.random(shape[1:]) > 0.2
    return rng.standard_normal(shape), rng.random(shape) * (rng.random(shape) > 0.1), valid


def test_correlation_is_the_weighted_sum_over_pairs():
    score, fisher, valid = maps()
    geometry = PairGeometry.from_raster(valid, 0.1, 0.6)
    correlation = amplitude_correlation(np.where(valid, score, np.nan), np.where(valid, fisher, np.nan), geometry)
    y, x = np.nonzero(valid)
    distance = np.hypot(y[:, None] - y, x[:, None] - x)
    bins = np.rint(distance).astype(int)
    for row in range(3):
        s, f = score[row][valid], fisher[row][valid]
        for b in range(7):
            pairs = bins == b
            expected = (np.outer(s, s) * pairs).sum() / (np.outer(f, f) * pairs).sum()
            assert correlation[row, b] == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_noise_alone_has_unit_significance_and_a_signal_raises_it():
    rng = np.random.default_rng(2)
    fisher = rng.uniform(1.0, 20.0, (400, 30, 30))
    noise = np.sqrt(fisher) * rng.standard_normal(fisher.shape)
    valid = np.ones((30, 30), dtype=bool)
    assert mean_square_significance(noise, fisher, valid).mean() == pytest.approx(1.0, abs=0.01)
    amplitude = 0.5 * rng.standard_normal((400, 1, 1))
    signal = noise + amplitude * fisher
    expected = 1.0 + (amplitude**2 * fisher).mean()
    assert mean_square_significance(signal, fisher, valid).mean() == pytest.approx(expected, rel=0.05)
    geometry = PairGeometry.from_raster(valid, 0.1, 0.5)
    correlation = amplitude_correlation(signal, fisher, geometry)[:, 1:]
    np.testing.assert_allclose(correlation.mean(axis=0), (amplitude**2).mean(), rtol=0.02)


def test_positions_without_information_do_not_count():
    score, fisher, valid = maps(3)
    fisher = np.maximum(fisher, 0.01)
    half = fisher.copy()
    half[:, :, 5:] = 0.0
    left = valid & (np.arange(11) < 5)
    np.testing.assert_allclose(
        mean_square_significance(score, half, valid), mean_square_significance(score, fisher, left)
    )
    zero = np.zeros_like(fisher)
    geometry = PairGeometry.from_raster(valid, 0.1, 0.5)
    np.testing.assert_array_equal(amplitude_correlation(zero, zero, geometry), 0.0)
    with pytest.raises(ValueError, match="no valid position with Fisher information"):
        mean_square_significance(score, zero, valid)
    with pytest.raises(ValueError, match="not finite"):
        amplitude_correlation(np.where(valid, np.nan, 0.0), fisher[0], geometry)
