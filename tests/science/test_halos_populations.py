"""Mean subhalo populations against published fits and against an independent prototype."""

from __future__ import annotations

import math

import numpy as np
import pytest

from warmlens.cosmology import Cosmology, LensGeometry
from warmlens.halos.population import HaloGenerator, HaloModel
from warmlens.halos.power_spectrum import half_mode_mass

COSMOLOGY = Cosmology()
LN10 = math.log(10.0)
EDGES = np.arange(7.5, 11.6, 0.5)  # log10(m_acc/Msun)


@pytest.fixture(scope="module")
def geometry():
    return LensGeometry.from_redshifts(COSMOLOGY, 0.295, 0.658)


@pytest.fixture(scope="module")
def cold_trees(geometry):
    """300 trees each of 10^12.5 and 10^13.5 Msun, resolved to 1e-5 of their mass."""
    trees = {}
    for log_mass in (12.5, 13.5):
        generator = HaloGenerator(COSMOLOGY, geometry, HaloModel(min_mass_msun=1e-5 * 10**log_mass))
        rng = np.random.default_rng(int(10 * log_mass))
        trees[log_mass] = [generator.tree(math.inf, 10**log_mass, rng) for _ in range(300)]
    return trees


@pytest.fixture(scope="module")
def unevolved(geometry):
    """Mean accreted haloes a host of 1e13 Msun in bins of `EDGES`, by particle mass."""
    generator = HaloGenerator(COSMOLOGY, geometry, HaloModel(min_mass_msun=10**7.5))
    rng = np.random.default_rng(20)
    counts = {}
    for m_th_kev, n_trees in ((1.0, 800), (2.0, 800), (3.3, 500), (math.inf, 200)):
        mass = np.concatenate([generator.tree(m_th_kev, 1e13, rng).m_acc_msun for _ in range(n_trees)])
        counts[m_th_kev] = np.histogram(np.log10(mass), EDGES)[0] / n_trees
    return counts


@pytest.mark.parametrize("log_mass", [12.5, 13.5])
def test_unevolved_mass_function_agrees_with_jiang_van_den_bosch_2016(log_mass, cold_trees):
    # first order: dN/dlnx = (0.13 x^-0.83 + 1.33 x^-0.02) exp(-5.67 x^1.19); stated tolerance 25%
    edges = np.arange(-4.5, -0.4, 0.5)
    x = np.concatenate([tree.m_acc_msun for tree in cold_trees[log_mass]]) / 10**log_mass
    measured = np.histogram(np.log10(x), edges)[0] / len(cold_trees[log_mass])
    for count, low, high in zip(measured, edges[:-1], edges[1:], strict=True):
        grid = np.logspace(low, high, 201)
        fit = (0.13 * grid**-0.83 + 1.33 * grid**-0.02) * np.exp(-5.67 * grid**1.19)
        assert count == pytest.approx(np.trapezoid(fit, np.log(grid)), rel=0.25), (low, high)


@pytest.mark.parametrize(("log_mass", "z_half"), [(12.5, 1.245), (13.5, 1.020)])
def test_formation_redshift_agrees_with_the_fit_of_jiang_van_den_bosch_2016(log_mass, z_half, cold_trees):
    measured = [float(COSMOLOGY.clock_to_redshift(tree.half_mass_clock)) for tree in cold_trees[log_mass]]
    assert np.median(measured) == pytest.approx(z_half, rel=0.05)


@pytest.mark.parametrize(
    ("m_th_kev", "first_bin", "expected"),
    [
        (2.0, 1, [0.029, 0.19, 0.48, 0.73, 0.87]),  # log10 m = 8.25 ... 10.25
        (3.3, 0, [0.070, 0.30, 0.60, 0.80]),  # 7.75 ... 9.25
        (1.0, 3, [0.037, 0.22, 0.53, 0.74]),  # 9.25 ... 10.75
    ],
)
def test_warm_suppression_agrees_with_the_prototype(m_th_kev, first_bin, expected, unevolved):
    ratio = (unevolved[m_th_kev] / unevolved[math.inf])[first_bin : first_bin + len(expected)]
    np.testing.assert_allclose(ratio, expected, rtol=0.12)


@pytest.mark.parametrize("m_th_kev", [1.0, 2.0, 3.3])
def test_warm_suppression_lies_between_published_fits(m_th_kev, unevolved):
    # Lovell et al. 2014 (subhaloes) and Schneider et al. 2012 (haloes), bins above 0.3 M_hm
    centre = 10 ** (0.5 * (EDGES[1:] + EDGES[:-1]))
    m_hm = half_mode_mass(m_th_kev, COSMOLOGY)
    use = (centre > 0.3 * m_hm) & (centre < 1e11)
    ratio = (unevolved[m_th_kev] / unevolved[math.inf])[use]
    assert use.sum() >= 2
    assert np.all(ratio > (1 + 2.7 * m_hm / centre[use]) ** -0.99 / 1.3)
    assert np.all(ratio < (1 + m_hm / centre[use]) ** -0.6 * 1.15)


def test_suppression_is_monotone_in_particle_mass(unevolved):
    small = EDGES[:-1] < 10.0
    assert np.all(unevolved[1.0][small] <= unevolved[2.0][small])
    assert np.all(unevolved[2.0][small] < unevolved[3.3][small])
    assert np.all(unevolved[3.3][small] < unevolved[math.inf][small])


# f_sub of 300 halos without friction, m > 1e-4 M: the fit of Jiang & van den Bosch 2016 for their tau_dyn,
# SatGen trees with the paper's; the scatter of a halo is 0.06, so the mean is good to 0.0035.
@pytest.mark.parametrize(
    ("log_mass", "tau_dyn", "expected", "tolerance"),
    [
        (12.5, "jvdb16", 0.1090, 0.18),
        (13.5, "jvdb16", 0.1354, 0.18),
        (12.5, "paper", 0.061, 0.25),
        (13.5, "paper", 0.069, 0.25),
    ],
)
def test_subhalo_mass_fraction(log_mass, tau_dyn, expected, tolerance, geometry):
    mass = 10**log_mass
    model = HaloModel(tau_dyn=tau_dyn, min_mass_msun=1e-4 * mass, friction_amplitude=1e9)
    generator = HaloGenerator(COSMOLOGY, geometry, model)
    rng = np.random.default_rng(30)
    f_sub = np.mean([generator.draw(math.inf, mass, 1.0, rng).f_sub for _ in range(300)])
    assert f_sub == pytest.approx(expected, rel=tolerance)


def test_crowding_of_the_central_field(geometry):
    # prototype: 57 subhaloes above 1e7 Msun in 4" x 4", 10^13.5 Msun, cold (20 trees x 3 projections)
    generator = HaloGenerator(COSMOLOGY, geometry, HaloModel())
    rng = np.random.default_rng(40)
    counts = [generator.draw(math.inf, 10**13.5, 2.0, rng).subhalos.m_bound.size for _ in range(15)]
    assert np.mean(counts) == pytest.approx(57.0, rel=0.25)
