"""Mean subhalo populations against published fits and against an independent prototype."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from warmlens.cosmology import G_NEWTON, Cosmology, LensGeometry
from warmlens.halos.dark_matter import ColdDarkMatter, ThermalRelic
from warmlens.halos.lens_halo import HaloGenerator, HaloModel
from warmlens.halos.population import HaloPopulation
from warmlens.halos.profiles import infall_structure

COSMOLOGY = Cosmology()
LN10 = math.log(10.0)
EDGES = np.arange(7.5, 11.6, 0.5)  # log10(m_acc/Msun)


@pytest.fixture(scope="module")
def geometry():
    return LensGeometry.from_redshifts(COSMOLOGY, 0.295, 0.658)


@pytest.fixture(scope="module")
def unevolved(geometry):
    """Mean accreted halos a host of 1e13 Msun in bins of `EDGES`, by particle mass."""
    generator = HaloGenerator(COSMOLOGY, geometry, HaloModel(min_mass_msun=10**7.5))
    rng = np.random.default_rng(20)
    counts = {}
    for m_th_kev, n_trees in ((1.0, 800), (2.0, 800), (3.3, 500), (math.inf, 200)):
        tree, relic = generator.population.tree, generator.dark_matter(m_th_kev)
        mass = np.concatenate([tree(relic, 1e13, rng).m_acc_msun for _ in range(n_trees)])
        counts[m_th_kev] = np.histogram(np.log10(mass), EDGES)[0] / n_trees
    return counts


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
    other = unevolved[3.3 if m_th_kev == 2.0 else 2.0] / unevolved[math.inf]
    assert np.max(np.abs(other[first_bin : first_bin + len(expected)] / expected - 1)) > 0.3


def test_suppression_is_monotone_in_particle_mass(unevolved):
    small = EDGES[:-1] < 10.0
    assert np.all(unevolved[1.0][small] <= unevolved[2.0][small])
    assert np.all(unevolved[2.0][small] < unevolved[3.3][small])
    assert np.all(unevolved[3.3][small] < unevolved[math.inf][small])


@pytest.mark.parametrize("m_th_kev", [1.0, 2.0, 3.3])
def test_warm_suppression_agrees_with_lovell_2020_above_the_half_mode_mass(m_th_kev, unevolved):
    # subhalos, (1 + (4.2 M_hm/M)^2.5)^-0.2 with 20% of scatter, here 21% at worst; the
    # sharp-k filter cuts far more steeply below
    centre = 10 ** (0.5 * (EDGES[1:] + EDGES[:-1]))
    m_hm = ThermalRelic(m_th_kev, COSMOLOGY).half_mode_mass_msun
    ratio = unevolved[m_th_kev] / unevolved[math.inf]
    fit = (1 + (4.2 * m_hm / centre) ** 2.5) ** -0.2
    use = (centre > 0.8 * m_hm) & (centre < 1e11)
    np.testing.assert_allclose(ratio[use], fit[use], rtol=0.25)
    below = centre < 0.1 * m_hm
    assert np.all(ratio[below] < 0.5 * fit[below])


N_EVOLVED = 400
F_SUB = {12.5: 0.1090, 13.5: 0.1354}  # 0.3563 / N_tau^0.6 - 0.075, m > 1e-4 M, z = 0.295


@pytest.fixture(scope="module")
def evolved():
    """Cold halos without friction, m > 1e-4 M, as Jiang & van den Bosch 2016 count them; by log M and tau_dyn."""
    halos = {}
    for log_mass in F_SUB:
        for tau_dyn in ("jvdb16", "paper"):
            mass = 10**log_mass
            model = HaloModel(tau_dyn=tau_dyn, min_mass_msun=1e-4 * mass, friction_amplitude=1e9)
            population = HaloPopulation(COSMOLOGY, 0.295, model)
            rng = np.random.default_rng(30)
            draws = [population.draw(ColdDarkMatter(), mass, rng) for _ in range(N_EVOLVED)]
            halos[log_mass, tau_dyn] = draws
    return halos


@pytest.mark.parametrize("log_mass", F_SUB)
def test_subhalo_mass_fraction_agrees_with_jiang_van_den_bosch_2016(log_mass, evolved):
    def deviation(tau_dyn):
        """Distance from the fit beyond 10% of it, in Monte-Carlo errors of the mean."""
        f_sub = np.array([halo.f_sub for halo in evolved[log_mass, tau_dyn]])
        error = f_sub.std() / math.sqrt(N_EVOLVED)
        return (abs(f_sub.mean() - F_SUB[log_mass]) - 0.1 * F_SUB[log_mass]) / error

    assert deviation("jvdb16") < 2.0
    assert deviation("paper") > 5.0  # 0.1/H strips about twice too fast for A_ts = 1.54


@pytest.mark.parametrize(("log_mass", "expected"), [(12.5, 0.061), (13.5, 0.069)])
def test_subhalo_mass_fraction_of_the_paper_agrees_with_another_tree_code(log_mass, expected, evolved):
    # SatGen trees, stripped as printed; the error of our mean is about 5%, that of theirs is not known
    f_sub = np.array([halo.f_sub for halo in evolved[log_mass, "paper"]])
    assert f_sub.mean() == pytest.approx(expected, rel=0.2)


@pytest.mark.parametrize("log_mass", F_SUB)
def test_evolved_mass_function_agrees_with_jiang_van_den_bosch_2016(log_mass, evolved):
    # all orders: dN/dlnx = 0.31 f_sub x^-0.82 exp(-50 x^4); first order alone is 0.75-0.85 of it, here 0.71-0.79
    edges = np.arange(-4.0, -1.4, 0.5)
    fit = [_integral(lambda x: 0.31 * F_SUB[log_mass] * x**-0.82 * np.exp(-50 * x**4), *e) for e in _bins(edges)]

    def ratio(tau_dyn):
        x = np.concatenate([halo.m_bound for halo in evolved[log_mass, tau_dyn]]) / 10**log_mass
        return np.histogram(np.log10(x), edges)[0] / N_EVOLVED / np.array(fit)

    np.testing.assert_allclose(ratio("jvdb16"), 0.75, rtol=0.12)
    assert np.all(ratio("paper") < 0.6)


@pytest.mark.parametrize("log_mass", F_SUB)
def test_evolved_velocity_function_agrees_with_jiang_van_den_bosch_2016(log_mass, evolved):
    # dN/dlnx = 5.45 f_sub^1.4 y^-2.6 exp(-4 y^15), y = 1.536 x V_vir/V_max, x = v_max/V_vir of the host. The slope
    # agrees. The amplitude does not: with the paper's concentrations, V_max/V_vir = 1.03-1.05, there are 1.3-1.9
    # times more. 1.25 would meet it; that value is assumed here to test the slope, it is not one of theirs.
    # Their unevolved function counts all orders and is not compared.
    mass, edges = 10**log_mass, np.arange(-1.0, -0.55, 0.1)
    v_vir = math.sqrt(G_NEWTON * mass / float(COSMOLOGY.radius_200c(mass, 0.295)))
    x = np.concatenate([halo.v_max_kms for halo in evolved[log_mass, "jvdb16"]]) / v_vir
    counts = np.histogram(np.log10(x), edges)[0] / N_EVOLVED

    def ratio(v_max_ratio):
        def fit(x):
            y = 1.536 * x / v_max_ratio
            return 5.45 * F_SUB[log_mass] ** 1.4 * y**-2.6 * np.exp(-4 * y**15)

        return counts / np.array([_integral(fit, *e) for e in _bins(edges)])

    concentration = HaloPopulation(COSMOLOGY, 0.295, HaloModel()).cold_concentration(mass, 0.295)
    ours = float(infall_structure(np.array([mass]), np.array([0.295]), concentration, COSMOLOGY)[1][0]) / v_vir
    np.testing.assert_allclose(ratio(1.25), 1.0, rtol=0.15)
    assert np.all((ratio(ours) > 1.3) & (ratio(ours) < 1.9))
    steeper = ratio(1.25) * 10 ** (0.5 * (edges[:-1] + 0.8))  # the twin: a slope of -3.1
    assert np.max(np.abs(steeper - 1.0)) > 0.15


def _bins(edges):
    return itertools.pairwise(edges)


def _integral(function, low, high):
    grid = np.logspace(low, high, 201)
    return np.trapezoid(function(grid), np.log(grid))


def test_crowding_of_the_central_field(geometry):
    # prototype: 57 subhalos above 1e7 Msun in 4" x 4", 10^13.5 Msun, cold (20 trees x 3 projections)
    generator = HaloGenerator(COSMOLOGY, geometry, HaloModel())
    rng = np.random.default_rng(40)
    counts = [generator.draw(math.inf, 10**13.5, 2.0, rng).subhalos.m_bound.size for _ in range(15)]
    assert np.mean(counts) == pytest.approx(57.0, rel=0.25)
    orbits = HaloGenerator(COSMOLOGY, geometry, HaloModel(positions="orbit_infall"))  # prototype: 4.1
    counts = [orbits.draw(math.inf, 10**13.5, 2.0, rng).subhalos.m_bound.size for _ in range(30)]
    assert np.mean(counts) == pytest.approx(4.1, abs=1.5)
