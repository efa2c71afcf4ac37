from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from warmlens.halos.barrier import barrier_ratio
from warmlens.halos.dark_matter import TRANSFER_INDEX, ColdDarkMatter, DarkMatter, ThermalRelic, dark_matter
from warmlens.halos.model import HaloModel
from warmlens.halos.population import HaloPopulation

# keV: alpha [Mpc/h], half-mode k [h/Mpc], half-mode mass [Msun]
VIEL = {
    1.0: (0.048743, 9.2514, 2.069e10),
    2.0: (0.022582, 19.969, 2.057e9),
    3.3: (0.012953, 34.814, 3.882e8),
    5.0: (0.0081668, 55.216, 9.732e7),
    10.0: (0.0037837, 119.18, 9.677e6),
}


@pytest.mark.parametrize("m_th_kev", VIEL)
def test_half_mode_scales_match_reference_values(m_th_kev, cosmology):
    relic = ThermalRelic(m_th_kev, cosmology)
    alpha, k, mass = VIEL[m_th_kev]
    assert relic.alpha_mpch == pytest.approx(alpha, rel=3e-5)
    assert 2 * math.pi / relic.half_mode_wavelength_mpch == pytest.approx(k, rel=1e-4)
    assert relic.half_mode_mass_msun == pytest.approx(mass, rel=5e-4)


@pytest.mark.parametrize("form", TRANSFER_INDEX)
def test_half_mode_is_where_the_amplitude_is_half(form, cosmology):
    relic = ThermalRelic(2.0, cosmology, form)
    k = 2 * math.pi / relic.half_mode_wavelength_mpch
    assert relic.transfer(np.array([k]))[0] == pytest.approx(0.5, rel=1e-12)


def test_half_mode_wavelength_agrees_with_schneider_2012(cosmology):
    relic = ThermalRelic(1.0, cosmology)
    assert relic.half_mode_wavelength_mpch / relic.alpha_mpch == pytest.approx(13.93, abs=0.01)
    squared = ThermalRelic(1.0, cosmology, "bode01")  # another index has another ratio
    assert squared.half_mode_wavelength_mpch / squared.alpha_mpch != pytest.approx(13.93, abs=0.01)


def test_reference_cosmologies_give_the_printed_break():
    # prefactors at 1 keV where every other factor is 1 (dark matter alone counts)
    from warmlens.cosmology import Cosmology

    viel = Cosmology(H0=70.0, Om0=0.30, Ob0=0.05)
    bode = Cosmology(H0=65.0, Om0=0.45, Ob0=0.05)
    vogel = Cosmology(H0=67.36, Om0=0.12 / 0.6736**2 + 0.05, Ob0=0.05)
    assert ThermalRelic(1.0, viel, "viel05").alpha_mpch == pytest.approx(0.049, rel=1e-12)
    assert ThermalRelic(1.0, bode, "bode01").alpha_mpch == pytest.approx(0.048, rel=1e-12)
    assert ThermalRelic(1.0, vogel, "vogel23").alpha_mpch == pytest.approx(0.0437, rel=1e-12)


@pytest.mark.parametrize(("form", "index"), [("viel05", -1.11), ("bode01", -1.15), ("vogel23", -1.188)])
def test_break_is_a_power_of_the_particle_mass(form, index, cosmology):
    ratio = ThermalRelic(6.0, cosmology, form).alpha_mpch / ThermalRelic(3.0, cosmology, form).alpha_mpch
    assert ratio == pytest.approx(2.0**index, rel=1e-12)


@pytest.mark.parametrize("form", TRANSFER_INDEX)
def test_transfer_falls_with_k_and_rises_with_particle_mass(form, cosmology):
    k = np.geomspace(0.1, 300.0, 200)
    warm, warmer = (ThermalRelic(m, cosmology, form).transfer(k) for m in (4.0, 2.0))
    assert np.all(np.diff(warm) < 0)
    assert np.all((warmer > 0) & (warmer < warm) & (warm < 1))


def test_infinite_mass_is_a_model_of_its_own(cosmology):
    cold = dark_matter(math.inf, cosmology, "vogel23")
    assert cold == ColdDarkMatter()
    assert cold.resolution_msun == 0.0
    np.testing.assert_array_equal(cold.transfer(np.array([1e-3, 1e4])), 1.0)
    np.testing.assert_array_equal(cold.barrier_ratio(np.array([1.0, 1e13])), 1.0)


def test_relic_has_the_barrier_and_the_resolution_of_its_jeans_mass(cosmology):
    relic = dark_matter(2.0, cosmology)
    assert relic.resolution_msun == pytest.approx(2.559e7, rel=3e-4)
    mass = np.geomspace(1e6, 1e10, 20)
    np.testing.assert_array_equal(relic.barrier_ratio(mass), barrier_ratio(mass, relic.resolution_msun))


def test_equal_models_have_equal_hashes_and_others_do_not_compare(cosmology):
    assert dark_matter(2.0, cosmology) == dark_matter(2.0, cosmology)
    assert hash(dark_matter(2.0, cosmology)) == hash(dark_matter(2.0, cosmology))
    models = {dark_matter(2.0, cosmology, form) for form in TRANSFER_INDEX} | {dark_matter(math.inf, cosmology)}
    assert len(models) == 4
    assert {model.label for model in models} == {"thermal relic of 2 keV", "cold dark matter"}


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, -math.inf])
def test_impossible_particle_masses_are_errors(value, cosmology):
    with pytest.raises(ValueError, match=r"m_th_kev must be > 0 \(inf for cold dark matter\), got"):
        dark_matter(value, cosmology)
    with pytest.raises(ValueError, match=r"m_th_kev must be finite and >= 0\.001 keV, got"):
        ThermalRelic(value, cosmology)


def test_a_relic_too_light_for_any_halo(cosmology):
    with pytest.raises(ValueError, match=r"m_th_kev must be finite and >= 0\.001 keV, got 1e-100"):
        dark_matter(1e-100, cosmology)


def test_unknown_transfer_function_is_an_error(cosmology):
    with pytest.raises(ValueError, match='transfer_function must be one of "viel05", "bode01", "vogel23", got'):
        dark_matter(2.0, cosmology, "other")


@dataclass(frozen=True)
class SharpCutoff:
    """A toy: no power beyond a wave number, the barrier of cold dark matter."""

    k_cut_hmpc: float
    resolution_msun: float = 1e8
    label: str = "sharp cut-off"

    def transfer(self, k_hmpc):
        return np.where(k_hmpc < self.k_cut_hmpc, 1.0, 0.0)

    def barrier_ratio(self, mass_msun):
        return np.ones_like(mass_msun)


def test_another_model_joins_by_transfer_barrier_and_resolution(cosmology):
    population = HaloPopulation(cosmology, 0.295, HaloModel())
    toy: DarkMatter = SharpCutoff(30.0)
    assert population.resolution_msun(toy) == 1e8
    # the filter's edge passes the cut-off at R = 2.5/k: no halo branches off below that mass
    radius = 2.5 / 30.0 / cosmology.h
    edge = 4 * math.pi / 3 * cosmology.mean_density_msun_mpc3 * radius**3
    halo = population.draw(toy, 1e13, np.random.default_rng(1))
    assert halo.n_surviving > 10
    assert 0.9 * edge < halo.m_acc.min() < 3 * edge
    cold = population.draw(ColdDarkMatter(), 1e13, np.random.default_rng(1))
    assert cold.m_acc.min() < 0.1 * edge


def test_a_model_without_a_usable_resolution_is_an_error(cosmology):
    population = HaloPopulation(cosmology, 0.295, HaloModel())
    for resolution in (-1.0, math.nan, math.inf):
        toy = SharpCutoff(30.0, resolution_msun=resolution)
        with pytest.raises(ValueError, match="resolution_msun of sharp cut-off must be finite and >= 0, got"):
            population.draw(toy, 1e13, np.random.default_rng(1))
