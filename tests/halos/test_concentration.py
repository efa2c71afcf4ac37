from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import kstest, norm

from warmlens.halos.concentration import ConcentrationRelation, FormationHistory, scatter_concentration
from warmlens.halos.dark_matter import dark_matter
from warmlens.halos.power_spectrum import filtered_variance

COLD = ConcentrationRelation()
# keV, log10 M, log10 M', c_WDM / c_CDM
MAPPING = [
    (2.0, 9.0, 15.52, 0.339),
    (2.0, 9.5, 13.83, 0.488),
    (2.0, 10.0, 12.50, 0.661),
    (2.0, 11.0, 11.55, 0.913),
    (3.3, 8.5, 14.48, 0.371),
    (3.3, 9.0, 12.78, 0.535),
    (3.3, 10.0, 10.97, 0.852),
    (5.0, 8.0, 13.88, 0.378),
    (5.0, 9.0, 10.94, 0.726),
    (10.0, 8.0, 10.19, 0.696),
]


@pytest.fixture(scope="module")
def formation(cosmology, spectrum):
    return FormationHistory.of_cold_halos(
        filtered_variance(dark_matter(math.inf, cosmology).transfer, spectrum, cosmology, 2.5), 1e16
    )


@pytest.mark.parametrize(
    ("mass", "z", "c"),
    [
        (1e7, 0.295, 11.28),
        (1e8, 0.295, 9.55),
        (1e9, 0.295, 8.09),
        (1e10, 0.295, 6.86),
        (10**12.5, 0.295, 4.53),
        (10**13.5, 0.295, 3.84),
        (1e8, 3.0, 5.95),
    ],
)
def test_cold_concentrations_match_reference_values(mass, z, c):
    assert COLD(mass, z) == pytest.approx(c, abs=0.006)


@pytest.mark.parametrize(
    ("mass", "z", "c"),
    [
        (1e7, 0.295, 14.54),
        (1e8, 0.295, 11.98),
        (1e9, 0.295, 9.87),
        (1e10, 0.295, 8.14),
        (10**12.5, 0.295, 5.02),
        (10**13.5, 0.295, 4.14),
        (1e8, 3.0, 7.05),
    ],
)
def test_duffy08_matches_reference_values(mass, z, c, cosmology):
    assert ConcentrationRelation.duffy08(cosmology.h, 1.5)(mass, z) == pytest.approx(c, abs=0.006)
    assert ConcentrationRelation.duffy08(1.0, 1.5)(mass, z) != pytest.approx(c, abs=0.006)  # pivot without h


def test_scatter_is_log_normal_about_the_median():
    median = np.full(20_000, 8.0)
    drawn = scatter_concentration(median, 0.16, 1.5, np.random.default_rng(1))
    assert kstest(np.log10(drawn / 8.0), norm(0.0, 0.16).cdf).pvalue > 0.01
    assert kstest(np.log10(drawn / 8.0), norm(0.0, 0.15).cdf).pvalue < 1e-4
    assert scatter_concentration(median, 0.5, 6.0, np.random.default_rng(1)).min() == 6.0


def test_no_scatter_draws_no_random_number():
    rng = np.random.default_rng(1)
    median = np.array([5.0, 6.0])
    np.testing.assert_array_equal(scatter_concentration(median, 0.0, 1.5, rng), median)
    assert rng.bit_generator.state == np.random.default_rng(1).bit_generator.state


def test_concentration_has_a_floor():
    assert COLD(1e16, 20.0) == 1.5
    assert ConcentrationRelation(minimum=0.1)(1e16, 20.0) < 1.5


@pytest.mark.parametrize(("m_th_kev", "log_mass", "log_match", "c_ratio"), MAPPING)
def test_mapping_matches_reference_values(m_th_kev, log_mass, log_match, c_ratio, formation, cosmology, spectrum):
    warm = filtered_variance(dark_matter(m_th_kev, cosmology).transfer, spectrum, cosmology, 2.5)
    mass = np.array([10**log_mass])
    matched = formation.matching_mass(warm, mass)
    assert np.log10(matched[0]) == pytest.approx(log_match, abs=0.01)
    assert COLD(matched, 0.0)[0] / COLD(mass, 0.0)[0] == pytest.approx(c_ratio, rel=3e-3)


def test_cold_halos_map_to_themselves(formation, cosmology, spectrum):
    mass = np.geomspace(1e6, 1e15, 100)
    cold = filtered_variance(dark_matter(math.inf, cosmology).transfer, spectrum, cosmology, 2.5)
    np.testing.assert_allclose(formation.matching_mass(cold, mass), mass, rtol=1e-4)


def test_mapping_is_capped_where_variance_is_flat(formation, cosmology, spectrum):
    warm = filtered_variance(dark_matter(1.0, cosmology).transfer, spectrum, cosmology, 2.5)
    np.testing.assert_allclose(formation.matching_mass(warm, np.array([1e5, 1e8])), 1e16, rtol=1e-9)


def test_warmer_halos_map_to_heavier_ones(formation, cosmology, spectrum):
    mass = np.geomspace(1e8, 1e12, 60)
    matched = [
        formation.matching_mass(
            filtered_variance(dark_matter(m, cosmology).transfer, spectrum, cosmology, 2.5), mass
        )
        for m in (1.0, 2.0, 5.0)
    ]
    assert np.all(matched[2] > mass)
    assert np.all(matched[1] > matched[2])
    assert np.all(matched[0] >= matched[1])
