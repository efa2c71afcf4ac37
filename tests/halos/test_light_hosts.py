"""Hosts below twice the resolution of their trees: halos without subhalos, the limit of heavier ones."""

from __future__ import annotations

import numpy as np
import pytest

from warmlens.cosmology import LensGeometry
from warmlens.halos.dark_matter import ColdDarkMatter, ThermalRelic
from warmlens.halos.lens_halo import HaloGenerator, HaloModel
from warmlens.halos.population import MASS_BINS
from warmlens.products.halos import check_finite
from warmlens.sampling import draw_parameters, stream


@pytest.fixture(scope="module")
def generator(cosmology, geometry):
    return HaloGenerator(cosmology, geometry, HaloModel(tau_dyn="jvdb16", positions="nfw_infall"))


def test_the_whole_corner_of_a_wide_prior_is_drawn(generator):
    """0.05 to 5 keV and 10^12 to 10^13 Msun: some hosts lie below twice the resolution, and no sample fails."""
    n_samples = 400
    sample = draw_parameters(1131, (0, n_samples), (0.05, 5.0), (12.0, 13.0))
    without = 0
    for row in range(n_samples):
        m_th, m_halo = float(sample.m_th_kev[row]), 10.0 ** float(sample.log10_m_halo_msun[row])
        halo = generator.draw(m_th, m_halo, 5.6, stream(1131, "halos", row))
        check_finite(halo)
        if m_halo <= generator.population.lightest_host_msun(generator.dark_matter(m_th)):
            assert halo.n_accreted == halo.subhalos.m_bound.size == 0
            without += 1
    assert 2 < without < 18  # 1.6% of the prior


@pytest.mark.parametrize("share", [1e-6, 0.5, 1.0])
def test_a_light_host_is_smooth(generator, share):
    dark_matter = ThermalRelic(0.1, generator.cosmology)
    m_halo = share * generator.population.lightest_host_msun(dark_matter)
    halo = generator.draw_model(dark_matter, m_halo, 5.6, np.random.default_rng(1))
    check_finite(halo)
    assert all(values.shape == (0,) and values.dtype == np.float64 for values in vars(halo.subhalos).values())
    assert halo.n_accreted == halo.n_friction == halo.n_stripped_below == halo.n_surviving == halo.tree_steps == 0
    assert halo.f_sub == 0.0
    assert halo.z_half == generator.geometry.z_lens  # where its trunk ends
    np.testing.assert_array_equal(halo.cumulative_mass_function, np.zeros(MASS_BINS.size))
    assert not halo.cumulative_vmax_function.any()


@pytest.mark.parametrize("m_th_kev", [0.05, 0.3, 2.0, np.inf])
def test_the_population_goes_continuously_to_none(generator, m_th_kev):
    """Towards twice the resolution fewer and fewer halos are accreted, and the trunk ends nearer to its root."""
    dark_matter = generator.dark_matter(m_th_kev)
    lightest = generator.population.lightest_host_msun(dark_matter)
    accreted, z_half, masses = [], [], []
    for share in (100.0, 10.0, 3.0, 1.5, 1.01, 1.0 + 1e-6, 1.0 + 1e-12):
        draws = [
            generator.population.draw(dark_matter, share * lightest, np.random.default_rng(i)) for i in range(40)
        ]
        accreted.append(np.mean([halo.n_accreted for halo in draws]))
        z_half.append(np.mean([halo.z_half for halo in draws]))
        masses.append(np.mean([halo.f_sub for halo in draws]))
    assert accreted[0] > 2.0
    assert accreted == sorted(accreted, reverse=True)
    assert accreted[-1] == masses[-1] == 0.0
    z_lens = generator.geometry.z_lens
    assert z_lens <= z_half[-1] < z_half[1]  # within one step of the trunk


def test_lightest_host_is_twice_the_larger_of_floor_and_jeans_mass(cosmology):
    geometry = LensGeometry.from_redshifts(cosmology, 0.5, 2.0)
    population = HaloGenerator(cosmology, geometry, HaloModel(min_mass_msun=1e9)).population
    assert population.lightest_host_msun(ColdDarkMatter()) == 2e9
    assert population.lightest_host_msun(ThermalRelic(0.5, cosmology)) == pytest.approx(2 * 6.55e9, rel=1e-2)
