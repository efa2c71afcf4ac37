from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest

from warmlens.halos.positions import draw_nfw_radii, nfw_inverse_mass, project_isotropically
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
