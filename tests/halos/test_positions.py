from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest

from warmlens.halos.positions import (
    NfwOrbits,
    draw_nfw_radii,
    draw_orbit_radii,
    nfw_inverse_mass,
    project_isotropically,
)
from warmlens.halos.profiles import nfw_mass


def test_inverse_mass_inverts():
    x = np.geomspace(1e-4, 1e3, 300)
    np.testing.assert_allclose(nfw_inverse_mass(nfw_mass(x)), x, rtol=1e-6)


def test_radii_follow_the_nfw_mass_and_not_another_one():
    radii = draw_nfw_radii(300.0, 4.17, 20_000, np.random.default_rng(3))
    assert 0.0 < radii.min() < radii.max() <= 300.0

    def enclosed(concentration):
        return lambda r: nfw_mass(concentration * r / 300.0) / nfw_mass(concentration)

    assert kstest(radii, enclosed(4.17)).pvalue > 0.01
    assert kstest(radii, enclosed(6.0)).pvalue < 1e-6


def test_enclosed_fractions_match_reference_values():
    radii = draw_nfw_radii(1.0, 4.17, 400_000, np.random.default_rng(4))
    fractions = [np.mean(radii < r) for r in (0.05, 0.1, 0.2, 0.3, 0.5, 0.7)]
    np.testing.assert_allclose(fractions, [0.020, 0.065, 0.182, 0.306, 0.539, 0.743], atol=2.5e-3)


def test_each_point_can_have_its_own_host():
    sizes = np.repeat([10.0, 1000.0], 1000)
    radii = draw_nfw_radii(sizes, np.repeat([3.0, 12.0], 1000), 2000, np.random.default_rng(5))
    assert np.all(radii <= sizes)
    assert np.median(radii[1000:]) / 1000.0 < np.median(radii[:1000]) / 10.0


def test_directions_are_isotropic():
    x, y = project_isotropically(np.ones(200_000), np.random.default_rng(6))
    assert np.all(x**2 + y**2 <= 1.0 + 1e-12)
    for component in (x, y):  # each coordinate of an isotropic unit vector is uniform in [-1, 1]
        assert kstest(component, "uniform", args=(-1.0, 2.0)).pvalue > 0.01
    assert np.mean(x * y) == pytest.approx(0.0, abs=3e-3)


# concentration 5; circularity: pericentre and apocentre in R200c
TURNING = {0.1: (0.0383, 1.7218), 0.5: (0.2487, 1.6311), 0.9: (0.6544, 1.3235)}


@pytest.mark.parametrize("circularity", TURNING)
def test_turning_points_match_reference_values(circularity):
    pericentre, apocentre = NfwOrbits(np.array(5.0), np.array(circularity)).turning_points()
    assert (pericentre, apocentre) == pytest.approx(TURNING[circularity], abs=6e-5)


def test_circular_and_radial_orbits():
    pericentre, apocentre = NfwOrbits(np.array(8.0), np.array([0.0, 1.0])).turning_points()
    np.testing.assert_allclose(pericentre, [0.0, 1.0], atol=1e-6)
    assert apocentre[1] == pytest.approx(1.0, abs=1e-6)
    radii = draw_orbit_radii(100.0, 8.0, np.ones(50), np.random.default_rng(7))
    np.testing.assert_allclose(radii, 100.0, rtol=1e-12)


def orbit_distribution(concentration, circularity):
    """Share of the time below r/R200c by quadrature over the radial angle, and half the radial period."""
    orbits = NfwOrbits(np.array(concentration), np.array(circularity))
    pericentre, apocentre = map(float, orbits.turning_points())
    edges = np.linspace(0.0, np.pi, 20_001)
    phase, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * (apocentre - pericentre)
    speed = np.sqrt(orbits.radial_velocity_squared(pericentre + half * (1 - np.cos(phase))))
    time = np.concatenate(([0.0], np.cumsum(half * np.sin(phase) / speed))) * edges[1]
    r = pericentre + half * (1 - np.cos(edges))
    return lambda x: np.interp(x, r, time / time[-1]), time[-1]


def test_half_period_and_quantiles_match_reference_values():
    assert orbit_distribution(5.0, 0.5)[1] == pytest.approx(2.335, abs=1e-3)
    radii = draw_orbit_radii(1.0, 5.0, np.full(400_000, 0.5), np.random.default_rng(8))
    np.testing.assert_allclose(np.quantile(radii, [0.1, 0.5, 0.9]), [0.4528, 1.3033, 1.6185], atol=4e-3)


@pytest.mark.parametrize("concentration", [1.5, 4.2, 20.0])
@pytest.mark.parametrize("circularity", [0.07, 0.43, 0.91])
def test_orbit_radii_follow_the_time_spent_there_and_not_on_another_orbit(concentration, circularity):
    radii = draw_orbit_radii(300.0, concentration, np.full(20_000, circularity), np.random.default_rng(9)) / 300.0
    assert kstest(radii, orbit_distribution(concentration, circularity)[0]).pvalue > 0.01
    assert kstest(radii, orbit_distribution(concentration, circularity + 0.05)[0]).pvalue < 1e-6


def test_each_orbit_can_have_its_own_host_and_extreme_hosts_are_clipped():
    eta, rng = np.full(1000, 0.5), np.random.default_rng
    both = draw_orbit_radii(np.repeat([10.0, 1000.0], 1000), np.repeat([1.0, 60.0], 1000), np.tile(eta, 2), rng(1))
    clipped = draw_orbit_radii(
        np.repeat([10.0, 1000.0], 1000), np.repeat([1.5, 20.0], 1000), np.tile(eta, 2), rng(1)
    )
    np.testing.assert_array_equal(both, clipped)
    assert np.median(both[1000:]) > 50 * np.median(both[:1000])


def test_no_orbits_are_no_radii():
    assert draw_orbit_radii(1.0, 5.0, np.empty(0), np.random.default_rng(1)).shape == (0,)


def test_projected_separations_of_unit_vectors_follow_their_law():
    x, y = project_isotropically(np.ones(20_000), np.random.default_rng(10))
    separation = np.hypot(x, y)
    assert kstest(separation, lambda s: 1 - np.sqrt(1 - s**2)).pvalue > 0.01
    assert kstest(separation, lambda s: s**2).pvalue < 1e-6  # that of a flat disc
    assert kstest(np.arctan2(y, x), "uniform", args=(-np.pi, 2 * np.pi)).pvalue > 0.01
