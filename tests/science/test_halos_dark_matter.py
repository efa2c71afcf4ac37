"""What the particle changes in whole halos: trees, structure and the choice of the free-streaming break."""

from __future__ import annotations

import math

import numpy as np
import pytest

from warmlens.cosmology import Cosmology
from warmlens.halos.dark_matter import TRANSFER_INDEX, dark_matter
from warmlens.halos.model import HaloModel
from warmlens.halos.population import HaloPopulation

COSMOLOGY = Cosmology()


@pytest.fixture(scope="module")
def population():
    return HaloPopulation(COSMOLOGY, 0.295, HaloModel(tau_dyn="jvdb16", min_mass_msun=1e8))


def mean_counts(population, m_th_kev, form="viel05", count=60):
    """Mean number of survivors above 1e8, 1e9 and 1e10 Msun in 1e13 Msun, and its Monte-Carlo error."""
    rng = np.random.default_rng(60)
    model = dark_matter(m_th_kev, COSMOLOGY, form)
    halos = [population.draw(model, 1e13, rng) for _ in range(count)]
    counts = np.array([[(halo.m_bound > limit).sum() for limit in (1e8, 1e9, 1e10)] for halo in halos])
    return counts.mean(axis=0), counts.std(axis=0) / math.sqrt(count)


def test_evolved_counts_rise_with_the_particle_mass(population):
    means, errors = zip(*(mean_counts(population, m) for m in (1.0, 2.0, 5.0, math.inf)), strict=True)
    gain, error = np.diff(means, axis=0), np.hypot(errors[1:], errors[:-1])
    assert np.all(gain > -2 * error)
    assert np.all(gain[:, 0] > 5 * error[:, 0])


def test_very_heavy_particles_are_cold(population):
    cold, error = mean_counts(population, math.inf)
    for m_th_kev in (1e3, 1e6):
        np.testing.assert_allclose(mean_counts(population, m_th_kev)[0], cold, atol=4 * error.max())
    assert abs(mean_counts(population, 2.0)[0][0] - cold[0]) > 10 * error[0]  # 2 keV is far from it


def test_breaks_agree_in_what_they_do_to_halos(population):
    # half-mode masses of 2 keV: 2.06e9 (viel05), 1.50e9 (bode01), 2.04e9 (vogel23)
    scales = {form: dark_matter(2.0, COSMOLOGY, form).half_mode_mass_msun for form in TRANSFER_INDEX}
    assert scales == pytest.approx({"viel05": 2.057e9, "bode01": 1.501e9, "vogel23": 2.040e9}, rel=1e-3)
    viel, bode, vogel = (mean_counts(population, 2.0, form, 200) for form in TRANSFER_INDEX)
    assert bode[0][0] > viel[0][0] + 2 * np.hypot(bode[1][0], viel[1][0])
    assert vogel[0][0] == pytest.approx(viel[0][0], rel=0.25)
    assert np.all(np.abs(vogel[0][2] - viel[0][2]) < 4 * np.hypot(vogel[1][2], viel[1][2]))


@pytest.mark.parametrize("m_th_kev", [1.0, 3.3, math.inf])
@pytest.mark.parametrize("z_root", [0.0, 0.295])
def test_no_subhalo_is_heavier_than_its_host_or_less_than_its_truncation(m_th_kev, z_root):
    model = HaloModel(tau_dyn="jvdb16", min_mass_msun=1e8, positions="orbit_infall")
    population = HaloPopulation(COSMOLOGY, z_root, model)
    relic, rng = dark_matter(m_th_kev, COSMOLOGY), np.random.default_rng(61)
    for log_mass in (10.0, 11.5, 12.5, 13.5):
        halo = population.draw(relic, 10**log_mass, rng)
        assert np.all(halo.m_acc < 0.5 * 10**log_mass)
        assert np.all(halo.r_t_kpc > 0.0)
        assert halo.f_sub < 1.0
        tree = population.tree(relic, 10**log_mass, rng)
        assert np.all(tree.m_acc_msun <= tree.host_mass_msun)


def test_warm_halos_at_z_0_have_fewer_and_slower_subhalos():
    # hosts of 10^12.5 Msun at z = 0: the cumulative functions of m and v_max of Birrer et al. 2017, appendix B,
    # fall from colder to warmer models (five halos a model), most at the low end
    population = HaloPopulation(COSMOLOGY, 0.0, HaloModel(tau_dyn="jvdb16", min_mass_msun=1e8))
    halos = {}
    for m_th_kev in (2.0, math.inf):
        rng = np.random.default_rng(62)
        halos[m_th_kev] = [population.draw(dark_matter(m_th_kev, COSMOLOGY), 10**12.5, rng) for _ in range(5)]
    for name, limits in (("m_bound", (1e8, 1e9)), ("v_max_kms", (10.0, 20.0))):
        ratio = [
            np.mean([(getattr(halo, name) > limit).sum() for halo in halos[2.0]])
            / np.mean([(getattr(halo, name) > limit).sum() for halo in halos[math.inf]])
            for limit in limits
        ]
        assert ratio[0] < 0.4
        assert ratio[0] < ratio[1] < 1.0
