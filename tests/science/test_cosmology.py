"""The background against colossus and against direct integrals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from warmlens.cosmology import SPEED_OF_LIGHT_KMS, Cosmology, LensGeometry

COSMOLOGY = Cosmology()
REDSHIFTS = np.array([0.0, 0.1, 0.295, 0.658, 1.0, 2.0, 5.0, 10.0, 20.0])


def test_growth_agrees_with_colossus(peer):
    np.testing.assert_allclose(COSMOLOGY.growth(REDSHIFTS), peer.growthFactor(REDSHIFTS), rtol=1e-4)


def test_age_agrees_with_colossus(peer):
    np.testing.assert_allclose(COSMOLOGY.age(REDSHIFTS), peer.age(REDSHIFTS), rtol=1e-4)


def test_growth_is_the_growth_integral():
    def unnormalised(a: float) -> float:
        integral = quad(lambda x: (x / (COSMOLOGY.Om0 + COSMOLOGY.Ode0 * x**3)) ** 1.5, 0.0, a)[0]
        return float(COSMOLOGY.expansion(1 / a - 1)) * integral

    expected = [unnormalised(1 / (1 + z)) / unnormalised(1.0) for z in REDSHIFTS]
    np.testing.assert_allclose(COSMOLOGY.growth(REDSHIFTS), expected, rtol=1e-7)


def test_distances_are_integrals_of_light_travel():
    lens = LensGeometry.from_redshifts(COSMOLOGY, 0.295, 0.658)
    scale = SPEED_OF_LIGHT_KMS / COSMOLOGY.H0

    def comoving(z_from: float, z_to: float) -> float:
        return scale * quad(lambda z: 1 / float(COSMOLOGY.expansion(z)), z_from, z_to)[0]

    assert lens.d_lens_mpc == pytest.approx(comoving(0.0, 0.295) / 1.295, rel=1e-8)
    assert lens.d_source_mpc == pytest.approx(comoving(0.0, 0.658) / 1.658, rel=1e-8)
    assert lens.d_lens_source_mpc == pytest.approx(comoving(0.295, 0.658) / 1.658, rel=1e-8)
