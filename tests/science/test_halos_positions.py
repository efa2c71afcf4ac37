"""Where the subhalos of drawn halos lie, by mode, against the host's profile and an independent prototype."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest

from warmlens.cosmology import Cosmology
from warmlens.halos.dark_matter import ColdDarkMatter
from warmlens.halos.model import HaloModel
from warmlens.halos.population import HaloPopulation
from warmlens.halos.profiles import nfw_mass

COSMOLOGY = Cosmology()
MASS, Z_ROOT = 1e13, 0.295
RADII = np.array([0.1, 0.2, 0.3, 0.5, 0.7])  # R200c at the root


def draw(positions, count, **change):
    model = HaloModel(positions=positions, tau_dyn="jvdb16", min_mass_msun=1e8, **change)
    population = HaloPopulation(COSMOLOGY, Z_ROOT, model)
    rng = np.random.default_rng(50)
    return [population.draw(ColdDarkMatter(), MASS, rng) for _ in range(count)]


def scaled_radii(halos):
    return np.concatenate([halo.radius_kpc for halo in halos]) / float(COSMOLOGY.radius_200c(MASS, Z_ROOT))


def enclosed(halos):
    """Share of the subhalos within R200c that lie within each of `RADII`."""
    r = scaled_radii(halos)
    return np.array([(r < limit).sum() for limit in RADII]) / (r < 1.0).sum()


def test_evolved_subhalos_follow_the_host_with_nfw_host():
    r = scaled_radii(draw("nfw_host", 30))
    c = float(HaloPopulation(COSMOLOGY, Z_ROOT, HaloModel()).cold_concentration(MASS, Z_ROOT))
    assert c == pytest.approx(4.17, abs=0.01)
    assert r.size > 10_000
    assert kstest(r, lambda y: nfw_mass(c * y) / nfw_mass(c)).pvalue > 0.01
    assert kstest(r, lambda y: nfw_mass(1.2 * c * y) / nfw_mass(1.2 * c)).pvalue < 1e-6


def test_accreted_subhalos_on_orbits_follow_the_host_in_number():
    # Birrer et al. 2017, section 3.1.4: they "follow the NFW profile"; so they do by number, before stripping.
    # Prototype, 60 trees: 0.078, 0.197, 0.322, 0.556, 0.757; an NFW profile: 0.065, 0.182, 0.306, 0.539, 0.743.
    halos = draw("orbit_infall", 30, stripping_amplitude=0.0)
    np.testing.assert_allclose(enclosed(halos), [0.078, 0.197, 0.322, 0.556, 0.757], rtol=0.12)
    assert 0.15 < np.mean(scaled_radii(halos) > 1.0) < 0.25
    other = enclosed(draw("nfw_infall", 10, stripping_amplitude=0.0))
    assert np.all(np.abs(other / [0.078, 0.197, 0.322, 0.556, 0.757] - 1.0) > 0.12)


def test_evolved_subhalos_on_orbits_leave_the_centre():
    # ... but not in what is left of them: within 0.1 R200c the prototype has 0.006-0.008 of those above 1e8 Msun
    on_orbits, in_host = enclosed(draw("orbit_infall", 40))[0], enclosed(draw("nfw_host", 10))[0]
    assert 0.004 < on_orbits < 0.014
    assert in_host == pytest.approx(0.065, abs=0.012)


def test_modes_order_the_centre():
    host, infall, orbit = (enclosed(draw(mode, 15))[0] for mode in ("nfw_host", "nfw_infall", "orbit_infall"))
    assert orbit < 0.3 * host < host < infall
