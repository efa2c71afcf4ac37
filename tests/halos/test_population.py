from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.stats import kstest, norm

from warmlens.halos.dark_matter import ColdDarkMatter, ThermalRelic
from warmlens.halos.model import HaloModel
from warmlens.halos.population import MASS_BINS, VMAX_BINS, HaloPopulation

MODEL = HaloModel(min_mass_msun=1e8, tau_dyn="jvdb16")
COLD = ColdDarkMatter()


def population(cosmology, z_root=0.295, **change):
    return HaloPopulation(cosmology, z_root, dataclasses.replace(MODEL, **change))


def draw(drawn_from, dark_matter=COLD, m_halo=1e13, seed=1):
    return drawn_from.draw(dark_matter, m_halo, np.random.default_rng(seed))


def arrays(halo):
    return {name: values for name, values in vars(halo).items() if isinstance(values, np.ndarray)}


@pytest.mark.parametrize("z_root", [0.0, 0.295, 2.0])
@pytest.mark.parametrize("m_th_kev", [2.0, math.inf])
@pytest.mark.parametrize("positions", ["nfw_host", "nfw_infall", "orbit_infall"])
def test_halo_at_any_redshift_is_consistent(z_root, m_th_kev, positions, cosmology):
    dark_matter = COLD if m_th_kev == math.inf else ThermalRelic(m_th_kev, cosmology)
    halo = draw(population(cosmology, z_root, positions=positions), dark_matter, 10**12.5)
    assert halo.n_surviving > 5
    for name, values in arrays(halo).items():
        assert values.shape == (halo.n_surviving,), name
        assert np.all(np.isfinite(values)), name
        assert np.all(values >= 0.0), name
    assert np.all((halo.z_acc > z_root) & (halo.z_acc < 20.0))
    assert np.all((halo.m_bound >= 1e8) & (halo.m_bound < halo.m_acc))
    assert np.all(halo.m_acc < 0.5 * 10**12.5)  # the trunk is the heavier progenitor
    assert np.all(halo.r_t_kpc > 0.0)
    assert np.all((halo.circularity > 0.0) & (halo.circularity < 1.0))
    assert 0.0 < halo.f_sub < 1.0
    assert halo.n_accreted == halo.n_friction + halo.n_stripped_below + halo.n_surviving


def test_cumulative_functions_count_the_survivors(cosmology):
    halo = draw(population(cosmology, 0.0))
    np.testing.assert_array_equal(halo.cumulative_mass_function, [(halo.m_bound > 10**b).sum() for b in MASS_BINS])
    np.testing.assert_array_equal(halo.cumulative_vmax_function, [(halo.v_max_kms > b).sum() for b in VMAX_BINS])
    assert halo.f_sub == pytest.approx(halo.m_bound.sum() / 1e13)


def test_two_hosts_of_one_model_share_its_variance(cosmology, monkeypatch):
    tabulated = []
    transfer = ThermalRelic.transfer
    monkeypatch.setattr(ThermalRelic, "transfer", lambda relic, k: tabulated.append(relic) or transfer(relic, k))
    drawn_from = population(cosmology)
    for m_halo in (1e12, 1e13):
        draw(drawn_from, ThermalRelic(3.0, cosmology), m_halo)
    assert len(tabulated) == 1
    assert drawn_from.variance(ThermalRelic(3.0, cosmology)) is drawn_from.variance(ThermalRelic(3.0, cosmology))
    for i in range(8):  # newer models displace it
        drawn_from.variance(ThermalRelic(4.0 + i, cosmology))
    draw(drawn_from, ThermalRelic(3.0, cosmology))
    assert len(tabulated) == 10


def test_positions_use_the_circularity_of_the_friction(cosmology):
    host, orbit = (draw(population(cosmology, positions=p)) for p in ("nfw_host", "orbit_infall"))
    for name, values in arrays(host).items():
        if name != "radius_kpc":
            np.testing.assert_array_equal(values, getattr(orbit, name), err_msg=name)
    # rounder orbits keep to a narrower range of radii
    round_orbits = orbit.circularity > 0.7
    spread = [np.std(np.log(orbit.radius_kpc[mask])) for mask in (round_orbits, ~round_orbits)]
    assert spread[0] < spread[1]
    assert orbit.radius_kpc.max() > host.radius_kpc.max()  # beyond the radius at the root


def test_friction_spares_round_orbits(cosmology):
    drawn_from = population(cosmology, min_mass_msun=3e10, stripping_amplitude=0.0)
    halos = [draw(drawn_from, seed=seed) for seed in range(300)]
    eta = np.concatenate([halo.circularity for halo in halos])
    heavy = np.concatenate([halo.m_acc for halo in halos]) > 3e11
    error = 0.214 / math.sqrt(heavy.sum())
    assert eta[heavy].mean() > 0.5 + 3 * error
    assert abs(eta[~heavy].mean() - 0.5) < eta[heavy].mean() - 0.5


def test_scatter_moves_the_concentrations_and_no_tree(cosmology):
    without, with_scatter = (draw(population(cosmology, concentration_scatter_dex=s)) for s in (0.0, 0.16))
    for name in ("m_bound", "m_acc", "z_acc", "circularity"):
        np.testing.assert_array_equal(getattr(without, name), getattr(with_scatter, name))
    dex = np.log10(with_scatter.concentration / without.concentration)
    assert dex.size > 300
    assert kstest(dex, norm(0.0, 0.16).cdf).pvalue > 0.01
    assert kstest(dex, norm(0.0, 0.25).cdf).pvalue < 1e-4


def test_duffy08_concentrates_more(cosmology):
    paper, duffy = (draw(population(cosmology, concentration=name)) for name in ("paper", "duffy08"))
    np.testing.assert_array_equal(paper.m_bound, duffy.m_bound)
    assert np.all(duffy.concentration > paper.concentration)
    assert np.all(duffy.v_max_kms > paper.v_max_kms)


@pytest.mark.parametrize("z_root", [-0.1, 20.0, 25.0, math.nan])
def test_impossible_redshifts_are_errors(z_root, cosmology):
    with pytest.raises(ValueError, match=r"z_root must be >= 0 and below z_max = 20\.0, got"):
        HaloPopulation(cosmology, z_root, MODEL)


@pytest.mark.parametrize("z", [-1.0, -2.0, math.nan])
def test_the_background_has_no_redshift_of_minus_one_or_less(z, cosmology):
    for function in (cosmology.expansion, cosmology.matter_density, cosmology.age, cosmology.growth):
        with pytest.raises(ValueError, match="z must be > -1, got"):
            function(np.array([0.5, z]))


@pytest.mark.parametrize("m_halo", [0.0, -1.0, math.nan, math.inf])
def test_impossible_hosts_are_errors(m_halo, cosmology):
    message = r"m_halo_msun must be finite and exceed 2e\+08 Msun, twice the resolution for cold dark matter"
    with pytest.raises(ValueError, match=message):
        draw(population(cosmology), m_halo=m_halo)
