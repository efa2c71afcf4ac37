from __future__ import annotations

import numpy as np
import pytest

from warmlens.summaries.cumulative import counts_below, cumulative_distribution, threshold_grid


def test_default_grid_is_documented():
    np.testing.assert_allclose(threshold_grid(), np.arange(-40.0, -3.9, 0.5))


def test_counts_are_those_of_a_direct_comparison():
    rng = np.random.default_rng(0)
    delta_r = rng.normal(-5.0, 10.0, (2, 3, 9, 11)).round(1)  # rounded: some values equal a threshold
    valid = rng.random((9, 11)) < 0.7
    delta_r[..., ~valid] = np.nan
    thresholds = threshold_grid()
    counts = counts_below(delta_r, valid, thresholds)
    expected = (delta_r[..., valid][..., None, :] < thresholds[:, None]).sum(axis=-1)
    assert (delta_r[..., valid][..., None, :] == thresholds[:, None]).any()
    np.testing.assert_array_equal(counts, expected)
    np.testing.assert_allclose(cumulative_distribution(delta_r, valid, thresholds), expected / valid.sum())


def test_one_map_and_its_extremes():
    valid = np.ones((2, 2), dtype=bool)
    delta_r = np.array([[-100.0, -4.0], [-4.1, 5.0]])
    fraction = cumulative_distribution(delta_r, valid, threshold_grid())
    assert fraction[0] == 0.25  # deeper than the deepest threshold counts everywhere
    assert fraction[-1] == 0.5  # -4 itself is not below -4


def test_bad_input_is_refused():
    valid = np.ones((2, 2), dtype=bool)
    with pytest.raises(ValueError, match="not finite"):
        counts_below(np.full((2, 2), np.nan), valid, threshold_grid())
    with pytest.raises(ValueError, match="ascending"):
        counts_below(np.zeros((2, 2)), valid, np.array([-4.0, -40.0]))
    with pytest.raises(ValueError, match="raster"):
        counts_below(np.zeros((2, 3)), valid, threshold_grid())
    with pytest.raises(ValueError, match="valid"):
        cumulative_distribution(np.zeros((2, 2)), ~valid, threshold_grid())
    with pytest.raises(ValueError, match="deepest"):
        threshold_grid(-4.0, -40.0)
