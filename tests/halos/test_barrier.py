from __future__ import annotations

import math

import numpy as np
import pytest

from warmlens.halos.barrier import barrier_ratio, jeans_mass

MASS_RATIO = np.array([0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 30, 100])
FIT = [39.29, 7.777, 3.2055, 1.7422, 1.37282, 1.19825, 1.09000, 1.05042, 1.02043, 1.00767]
BARKANA = [38.03, 8.075, 3.169, 1.708, 1.3616, 1.2057, 1.0989, 1.0605, 1.0287, 1.0157]  # their own table


@pytest.mark.parametrize(
    ("m_th_kev", "mass"), [(1, 4.094e8), (2, 2.559e7), (3.3, 3.452e6), (5, 6.550e5), (10, 4.094e4)]
)
def test_jeans_mass_matches_reference_values(m_th_kev, mass, cosmology):
    assert jeans_mass(m_th_kev, cosmology) == pytest.approx(mass, rel=3e-4)


def test_barrier_matches_reference_values():
    np.testing.assert_allclose(barrier_ratio(MASS_RATIO * 3e8, 3e8), FIT, rtol=2e-4)


def test_barrier_is_within_4_percent_of_barkana_2001():
    np.testing.assert_allclose(barrier_ratio(MASS_RATIO, 1.0), BARKANA, rtol=0.04)


def test_massive_halos_do_not_feel_it():
    assert barrier_ratio(np.array([1e13]), 4e8)[0] == pytest.approx(1.0, abs=1e-4)


def test_cold_dark_matter_has_no_barrier(cosmology):
    assert jeans_mass(math.inf, cosmology) == 0.0
    np.testing.assert_array_equal(barrier_ratio(np.array([1.0, 1e13]), 0.0), 1.0)


def test_barrier_rises_towards_low_mass_without_overflow():
    x = np.linspace(-9.9, 5.0, 400)
    barrier = barrier_ratio(np.exp(x), 1.0)
    assert np.all(np.isfinite(barrier))
    assert np.all(np.diff(barrier) < 0)
    np.testing.assert_allclose(barrier[x < -4.0], 0.04 * np.exp(-2.3 * x[x < -4.0]), rtol=1e-3)


@pytest.mark.parametrize("value", [-1.0, math.nan])
def test_negative_jeans_mass_is_an_error(value):
    with pytest.raises(ValueError, match="jeans_mass_msun must be >= 0, got"):
        barrier_ratio(np.array([1e8]), value)
