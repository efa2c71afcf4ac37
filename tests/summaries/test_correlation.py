from __future__ import annotations

import numpy as np
import pytest

from warmlens.summaries.correlation import PairGeometry, correlation_function, excess_residuals

STEP = 0.05


def brute_force(delta_r, valid, step, n_dr, width, threshold):
    """All ordered pairs, one by one from the positions; nothing shared with the package."""
    y, x = np.nonzero(valid)
    value = np.array([v if v < threshold else 0.0 for v in delta_r[y, x]])
    sums, counts = np.zeros(n_dr), np.zeros(n_dr, dtype=int)
    for i in range(y.size):
        distance = step * np.sqrt((y - y[i]) ** 2 + (x - x[i]) ** 2)
        for b in range(n_dr):
            if b == 0:
                inside = distance == 0.0
            elif b == 1:
                inside = (distance > 0.0) & (distance < 1.5 * width)
            else:
                inside = (distance > (b - 0.5) * width) & (distance < (b + 0.5) * width)
            sums[b] += np.sum(value[i] * value[inside])
            counts[b] += inside.sum()
    return sums / counts, counts


@pytest.fixture
def scan():
    rng = np.random.default_rng(4)
    valid = rng.random((17, 23)) < 0.8
    delta_r = rng.normal(-2.0, 4.0, (3, 17, 23))
    delta_r[:, ~valid] = np.nan
    return delta_r, valid


@pytest.mark.parametrize(("width", "max_dr"), [(None, 0.5), (0.11, 0.7), (0.05, 1.0)])
def test_equals_the_sum_over_all_pairs(scan, width, max_dr):
    delta_r, valid = scan
    geometry = PairGeometry.from_raster(valid, STEP, max_dr, width)
    n_dr = geometry.dr_arcsec.size
    correlation = correlation_function(delta_r, geometry)
    assert correlation.shape == (3, n_dr)
    for row, one in zip(correlation, delta_r, strict=True):
        expected, counts = brute_force(one, valid, STEP, n_dr, width or STEP, -4.0)
        np.testing.assert_allclose(row, expected, rtol=1e-10)
        ordered = np.where(np.arange(n_dr) == 0, 1, 2) * geometry.counts
        np.testing.assert_array_equal(ordered, counts)


def test_default_bins_reach_two_and_a_half_arcsec():
    geometry = PairGeometry.from_raster(np.ones((80, 80), dtype=bool), STEP)
    np.testing.assert_allclose(geometry.dr_arcsec, np.arange(51) * 0.05, atol=1e-12)
    assert geometry.counts[0] == 6400
    # bin 1 holds the lags (0, 1), (1, 0), (1, 1), (1, -1)
    assert geometry.counts[1] == 2 * 80 * 79 + 2 * 79 * 79


def test_counts_of_a_large_raster_are_exact():
    valid = np.ones((200, 201), dtype=bool)
    geometry = PairGeometry.from_raster(valid, STEP)
    exact = (200 - geometry.lag_rows) * (201 - np.abs(geometry.lag_columns))
    bins = np.repeat(np.arange(51), np.diff(np.append(geometry.bin_starts, exact.size)))
    np.testing.assert_array_equal(geometry.counts, [exact[bins == b].sum() for b in range(51)])


def test_two_points_at_a_known_distance():
    valid = np.ones((30, 30), dtype=bool)
    delta_r = np.full((30, 30), -3.9)
    delta_r[4, 5], delta_r[4, 13] = -10.0, -5.0
    geometry = PairGeometry.from_raster(valid, STEP, 1.0)
    correlation = correlation_function(delta_r, geometry)
    expected = np.zeros(21)
    expected[0] = 125.0 / 900.0
    expected[8] = 50.0 / geometry.counts[8]
    np.testing.assert_allclose(correlation, expected, atol=1e-14)


def test_nothing_below_the_threshold_gives_exactly_zero(scan):
    _, valid = scan
    delta_r = np.full((2, *valid.shape), -4.0)  # not below -4
    assert (correlation_function(delta_r, PairGeometry.from_raster(valid, STEP, 0.5)) == 0.0).all()


def test_batches_do_not_matter(scan, monkeypatch):
    delta_r, valid = scan
    geometry = PairGeometry.from_raster(valid, STEP, 0.5)
    together = correlation_function(delta_r, geometry)
    monkeypatch.setattr("warmlens.summaries.correlation.BATCH_ELEMENTS", 1)
    np.testing.assert_allclose(correlation_function(delta_r, geometry), together, rtol=1e-12)
    np.testing.assert_allclose(correlation_function(delta_r[1], geometry), together[1], rtol=1e-12)


def test_threshold_selects():
    valid = np.ones((2, 2), dtype=bool)
    delta_r = np.array([[-10.0, -1.0], [3.0, -4.0]])
    np.testing.assert_array_equal(excess_residuals(delta_r, valid), [[-10.0, 0.0], [0.0, 0.0]])
    np.testing.assert_array_equal(excess_residuals(delta_r, valid, 0.0), [[-10.0, -1.0], [0.0, -4.0]])


def test_bad_input_is_refused(scan):
    delta_r, valid = scan
    geometry = PairGeometry.from_raster(valid, STEP, 0.5)
    broken = delta_r.copy()
    broken[1, np.nonzero(valid)[0][0], np.nonzero(valid)[1][0]] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        correlation_function(broken, geometry)
    with pytest.raises(ValueError, match="raster"):
        correlation_function(delta_r[:, :-1], geometry)
    with pytest.raises(ValueError, match="threshold"):
        correlation_function(delta_r, geometry, 1.0)
    with pytest.raises(ValueError, match="no pair"):
        PairGeometry.from_raster(valid, STEP, 2.5)
    with pytest.raises(ValueError, match="bin_width"):
        PairGeometry.from_raster(valid, STEP, 0.5, 0.01)
    with pytest.raises(ValueError, match="no pair"):
        PairGeometry.from_raster(np.zeros((5, 5), dtype=bool), STEP, 0.1)
