from __future__ import annotations

import math

import numpy as np
import pytest

from warmlens.halos import power_spectrum
from warmlens.halos.dark_matter import dark_matter
from warmlens.halos.power_spectrum import filtered_variance, top_hat_sigma

DECADES = 10.0 ** np.arange(6, 16)
SIGMA_TOP_HAT = [8.4527, 7.2428, 6.0912, 5.0075, 4.0030, 3.0909, 2.2848, 1.5958, 1.0321, 0.6006]
SIGMA_SHARP_K = {
    math.inf: [9.0941, 7.8488, 6.6568, 5.5264, 4.4683, 3.4956, 2.6232, 1.8645, 1.2294, 0.7269],
    1.0: [4.0091, 4.0091, 4.0091, 4.0086, 3.9187, 3.3828, 2.6050, 1.8619, 1.2290, 0.7268],
    2.0: [5.0173, 5.0173, 5.0168, 4.9216, 4.3407, 3.4744, 2.6199, 1.8641, 1.2293, 0.7269],
    3.3: [5.7959, 5.7959, 5.7596, 5.3085, 4.4298, 3.4894, 2.6222, 1.8644, 1.2294, 0.7269],
    5.0: [6.4703, 6.4655, 6.2312, 5.4435, 4.4544, 3.4934, 2.6228, 1.8645, 1.2294, 0.7269],
    10.0: [7.6409, 7.3970, 6.5674, 5.5111, 4.4658, 3.4952, 2.6231, 1.8645, 1.2294, 0.7269],
}
SLOPE_COLD = [0.0606, 0.0675, 0.0759, 0.0861, 0.0989, 0.1149, 0.1353, 0.1626, 0.2016, 0.2580]


def test_cold_power_matches_reference_values(spectrum):
    k = np.array([1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0])
    reference = [3477.83, 20706.0, 5955.88, 70.0796, 0.240027, 5.00663e-4]
    power = np.exp(np.interp(np.log(k), np.log(spectrum.k_hmpc), np.log(spectrum.power)))
    np.testing.assert_allclose(power, reference, rtol=5e-4)


def test_top_hat_variance_reproduces_sigma8(cosmology, spectrum):
    assert top_hat_sigma(spectrum, np.array([8.0])) == pytest.approx(cosmology.sigma8, abs=1e-6)


def test_top_hat_sigma_matches_reference_values(cosmology, spectrum):
    radius_mpc = np.cbrt(3 * DECADES / (4 * math.pi * cosmology.mean_density_msun_mpc3))
    np.testing.assert_allclose(top_hat_sigma(spectrum, radius_mpc * cosmology.h), SIGMA_TOP_HAT, rtol=1e-3)


@pytest.mark.parametrize("m_th_kev", SIGMA_SHARP_K)
def test_sharp_k_sigma_matches_reference_values(m_th_kev, cosmology, spectrum):
    table = filtered_variance(dark_matter(m_th_kev, cosmology).transfer, spectrum, cosmology, 2.5)
    np.testing.assert_allclose(np.sqrt(table.variance(DECADES)), SIGMA_SHARP_K[m_th_kev], rtol=1e-3)


def test_sharp_k_slope_matches_reference_values(cosmology, spectrum):
    cold = filtered_variance(dark_matter(math.inf, cosmology).transfer, spectrum, cosmology, 2.5)
    np.testing.assert_allclose(cold.log_slope(DECADES), SLOPE_COLD, rtol=2e-3)
    warm = filtered_variance(dark_matter(2.0, cosmology).transfer, spectrum, cosmology, 2.5)
    np.testing.assert_allclose(warm.log_slope(np.array([1e8, 1e9, 1e10])), [3.24e-4, 0.02622, 0.07987], rtol=2e-3)


@pytest.mark.parametrize("m_th_kev", [math.inf, 2.0])
def test_slope_is_the_derivative_of_sigma(m_th_kev, cosmology, spectrum):
    table = filtered_variance(dark_matter(m_th_kev, cosmology).transfer, spectrum, cosmology, 2.5)
    mass = np.geomspace(1e9, 1e15, 25)
    step = 1.05
    numerical = -0.5 * np.log(table.variance(mass * step) / table.variance(mass / step)) / (2 * np.log(step))
    np.testing.assert_allclose(table.log_slope(mass), numerical, rtol=3e-3)


def test_grid_is_fine_enough(cosmology, spectrum, monkeypatch):
    mass = np.geomspace(1e5, 1e15, 301)
    for m_th_kev in (1.0, 5.0, math.inf):
        coarse = filtered_variance(dark_matter(m_th_kev, cosmology).transfer, spectrum, cosmology, 2.5)
        with monkeypatch.context() as patch:
            patch.setattr(power_spectrum, "_K_POINTS", 50_001)
            fine = filtered_variance(
                dark_matter(m_th_kev, cosmology).transfer, power_spectrum.cdm_power(cosmology), cosmology, 2.5
            )
        np.testing.assert_allclose(coarse.variance(mass), fine.variance(mass), rtol=1e-5)
        massive = mass[fine.log_slope(mass) > 1e-6]
        np.testing.assert_allclose(coarse.log_slope(massive), fine.log_slope(massive), rtol=2e-3)


def test_variance_falls_with_mass_and_grows_with_particle_mass(cosmology, spectrum):
    mass = np.geomspace(1e6, 1e15, 100)
    variances = [
        filtered_variance(dark_matter(m, cosmology).transfer, spectrum, cosmology, 2.5).variance(mass)
        for m in (1.0, 3.0, math.inf)
    ]
    for variance in variances:
        assert np.all(np.diff(variance) <= 0)  # flat to the last digit far below the half-mode mass
        assert np.all(np.diff(variance[mass > 1e9]) < 0)
    assert np.all(variances[0] < variances[1])
    assert np.all(variances[1] < variances[2])
