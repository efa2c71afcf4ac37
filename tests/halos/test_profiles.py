from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad

from warmlens.cosmology import G_NEWTON
from warmlens.halos import profiles


def test_velocity_peak_constants():
    def minus_velocity_squared(x):
        return -profiles.nfw_mass(x) / x

    x = np.linspace(2.1, 2.2, 100_001)
    best = x[np.argmin(minus_velocity_squared(x))]
    assert best == pytest.approx(profiles.X_MAX, abs=1e-4)
    assert profiles.nfw_mass(profiles.X_MAX) == pytest.approx(profiles.G_MAX, rel=1e-8)


def test_infall_structure_is_that_of_an_nfw_halo(cosmology):
    mass, z, c = np.array([1e9]), np.array([1.0]), np.array([8.0])
    r_max, v_max = profiles.infall_structure(mass, z, c, cosmology)
    r_s, rho_s = profiles.nfw_parameters(r_max, v_max)
    norm = profiles.nfw_norm(r_s, rho_s)
    r_200 = cosmology.radius_200c(mass, z)
    np.testing.assert_allclose(r_s * c, r_200, rtol=1e-8)
    np.testing.assert_allclose(norm * profiles.nfw_mass(c), mass, rtol=1e-7)
    enclosed = norm * profiles.nfw_mass(r_max / r_s)
    np.testing.assert_allclose(v_max**2, G_NEWTON * enclosed / r_max, rtol=1e-7)


def test_tidal_tracks_reference_values():
    r_ratio, v_ratio = profiles.tidal_tracks(np.array([1.0, 0.5, 0.1, 0.01]))
    np.testing.assert_allclose(r_ratio, [1.0, 0.69519, 0.33274, 0.12912], atol=6e-6)
    np.testing.assert_allclose(v_ratio, [1.0, 0.91131, 0.63658, 0.33013], atol=6e-6)


def test_tidal_tracks_identity():
    x = np.geomspace(1e-4, 1.0, 50)
    r_ratio, v_ratio = profiles.tidal_tracks(x)
    np.testing.assert_allclose(r_ratio * v_ratio**2, x * np.sqrt(2 / (1 + x)), rtol=1e-12)


def test_total_mass_reference_values():
    mass = profiles.tnfw_total_mass(np.array([1.0, 5.0]))
    np.testing.assert_allclose(mass, [(math.pi - 2) / 4, 1.0478725], rtol=1e-7)


def test_truncation_inverts_the_total_mass():
    tau = np.geomspace(2e-3, 5e3, 777)
    np.testing.assert_allclose(profiles.truncation(profiles.tnfw_total_mass(tau)), tau, rtol=2e-6)


@pytest.mark.parametrize("ratio", [0.0, -1.0, np.nan, 100.0])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_impossible_mass_ratio_is_an_error(ratio):
    with pytest.raises(ValueError, match="mass_ratio must lie between"):
        profiles.truncation(np.array([1.0, ratio]))


@pytest.mark.parametrize(("bound_fraction", "tau"), [(1.0, 7.26), (0.5, 5.67), (0.1, 4.44), (1e-6, 4.13)])
def test_truncation_of_stripped_subhalos(bound_fraction, tau, cosmology):
    # c = 8: mu(tau) = g(c) sqrt((1+x)/2) whatever mass and redshift
    mass, z, c = np.array([3e9]), np.array([2.0]), np.array([8.0])
    r_max, v_max = profiles.infall_structure(mass, z, c, cosmology)
    r_ratio, v_ratio = profiles.tidal_tracks(np.array([bound_fraction]))
    r_s, rho_s = profiles.nfw_parameters(r_max * r_ratio, v_max * v_ratio)
    measured = profiles.truncation(bound_fraction * mass / profiles.nfw_norm(r_s, rho_s))
    assert measured[0] == pytest.approx(tau, abs=6e-3)


def density(x, tau):
    return 1 / (x * (1 + x) ** 2) * tau**2 / (tau**2 + x**2)


@pytest.mark.parametrize("tau", [0.3, 1.0, 4.0, 20.0])
def test_total_mass_is_the_integral_of_the_density(tau):
    inside = quad(lambda s: s**2 * density(s, tau), 0.0, tau, epsabs=0, epsrel=1e-11)[0]
    outside = quad(lambda s: s**2 * density(s, tau), tau, math.inf, epsabs=0, epsrel=1e-11)[0]
    assert profiles.tnfw_total_mass(tau) == pytest.approx(inside + outside, rel=1e-9)
