"""Statistics of the merger trees against published fits and against the envelope algorithm.

Tolerances are those of the fits plus three times the Monte-Carlo error; every comparison is repeated with a
wrong parameter, which it must reject. That is G0 where time enters. A mass function of what was accreted does
not know G0, which scales all rates alike and so only moves the clock: there it is the sign of gamma1.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
import pytest
from numba import njit

from warmlens.cosmology import Cosmology
from warmlens.halos.dark_matter import dark_matter
from warmlens.halos.merger_tree import BRANCHING, branching_table, grow_tree
from warmlens.halos.power_spectrum import SharpKVariance, cdm_power, filtered_variance, top_hat_sigma

from ..halos.all_orders import grow_all_orders

COSMOLOGY = Cosmology()
SPECTRUM = cdm_power(COSMOLOGY)
CLOCKS = (float(COSMOLOGY.collapse_clock(0.295)), float(COSMOLOGY.collapse_clock(20.0)))
PCH08 = BRANCHING["pch08"]
TOO_FAST = (1.3 * PCH08[0], *PCH08[1:])
TOO_SLOW = (PCH08[0] / 1.3, *PCH08[1:])
WRONG_SIGN = (PCH08[0], -PCH08[1], *PCH08[2:])


@dataclass(frozen=True)
class Mean:
    """Mean over trees and its standard error, one entry a bin."""

    value: np.ndarray
    error: np.ndarray

    @classmethod
    def of(cls, trees):
        trees = np.asarray(trees, dtype=np.float64)
        return cls(trees.mean(axis=0), trees.std(axis=0, ddof=1) / math.sqrt(len(trees)))

    def excess(self, expected, tolerance):
        """Largest deviation in units of what is allowed: tolerance * expected + 3 Monte-Carlo errors."""
        return np.max(np.abs(self.value - expected) / (tolerance * expected + 3.0 * self.error))


def variance_of(m_th_kev):
    return filtered_variance(dark_matter(m_th_kev, COSMOLOGY).transfer, SPECTRUM, COSMOLOGY, 2.5)


def count(mass, root, edges):
    return np.histogram(np.log10(mass / root), edges)[0]


def integral(fit, edges):
    """Integral of dN/dlnx over bins in log10 x."""
    grids = [np.logspace(low, high, 201) for low, high in itertools.pairwise(edges)]
    return np.array([np.trapezoid(fit(x), np.log(x)) for x in grids])


def grown(
    root, resolution, branching, n_trees, seed, grow, variance=None, clocks=CLOCKS, factor=1.197, ratio=None
):
    """Trees of cold dark matter in the lens of the paper, unless set otherwise."""
    variance, ratio = variance or variance_of(math.inf), ratio or np.ones_like
    table = branching_table(variance, root, resolution, branching, factor, ratio)
    rng = np.random.default_rng(seed)
    return (grow(table, *clocks, rng) for _ in range(n_trees))


# Unevolved mass functions, x = m_acc/M (Jiang & van den Bosch 2016): 25% at first order, where the fit is known
# to exceed PCH08 trees at small x, and 8% at all orders over 1e-4 < x < 0.05.


def first_order_fit(x):
    return (0.13 * x**-0.83 + 1.33 * x**-0.02) * np.exp(-5.67 * x**1.19)


def all_order_fit(x):
    return 0.22 * x**-0.91 * np.exp(-6.0 * x**3)


def first_order_excess(log_mass, branching):
    root, edges = 10**log_mass, np.linspace(-4.0, -0.5, 8)
    trees = grown(root, 1e-4 * root, branching, 1000, 1, grow_tree)
    measured = Mean.of([count(tree.m_acc_msun, root, edges) for tree in trees])
    return measured.excess(integral(first_order_fit, edges), 0.25)


def all_order_excess(log_mass, branching):
    root, edges = 10**log_mass, np.linspace(-4.0, math.log10(0.05), 7)
    trees = grown(root, 1e-4 * root, branching, 400, 2, grow_all_orders)
    measured = Mean.of([count(tree.m_acc_msun[1:], root, edges) for tree in trees])
    return measured.excess(integral(all_order_fit, edges), 0.08)


@pytest.mark.parametrize("log_mass", [12.5, 13.5])
@pytest.mark.parametrize("excess", [first_order_excess, all_order_excess])
def test_unevolved_mass_functions_agree_with_jiang_van_den_bosch_2016(excess, log_mass):
    assert excess(log_mass, PCH08) < 1.0
    assert excess(log_mass, WRONG_SIGN) > 1.0


def test_unevolved_mass_function_does_not_depend_on_the_overall_rate():
    root, edges = 1e13, np.linspace(-3.5, -0.5, 7)
    means = [
        Mean.of(
            [count(tree.m_acc_msun, root, edges) for tree in grown(root, 10**9.5, rates, 2000, seed, grow_tree)]
        )
        for seed, rates in ((1, PCH08), (2, TOO_FAST), (3, WRONG_SIGN))
    ]
    error = np.hypot(means[0].error, means[1].error)
    assert Mean(means[0].value, error).excess(means[1].value, 0.01) < 1.0
    assert Mean(means[0].value, error).excess(means[2].value, 0.01) > 1.0


# Median redshift at which the trunk had half its mass: Jiang & van den Bosch 2016, 5%. The error of a median is
# 1.253 times that of the mean.


def formation_excess(log_mass, expected, branching):
    root = 10**log_mass
    trees = grown(root, 1e-3 * root, branching, 2000, 3, grow_tree)
    z_half = COSMOLOGY.clock_to_redshift(np.array([tree.half_mass_clock for tree in trees]))
    error = 1.253 * z_half.std(ddof=1) / math.sqrt(z_half.size)
    return Mean(np.median(z_half), error).excess(expected, 0.05)


@pytest.mark.parametrize(("log_mass", "z_half"), [(12.5, 1.245), (13.5, 1.020)])
def test_formation_redshift_agrees_with_the_fit_of_jiang_van_den_bosch_2016(log_mass, z_half):
    assert formation_excess(log_mass, z_half, PCH08) < 1.0
    assert formation_excess(log_mass, z_half, TOO_FAST) > 1.0


# Share of the mass of a halo at z = 0 that is in progenitors of M1 at dz: the fit of Cole et al. 2008 to the
# Millennium simulation, 20%, with the top-hat variance and the barrier 1.686 that it is written for. It ends at
# M1 = M/4: from there to M/2 PCH08 trees hold 1.5 times the fit at dz = 1, with shorter steps as well.


def conditional_excess(dz, branching):
    root, edges = 1e13, np.linspace(-3.0, math.log10(0.25), 9)
    ln_mass = np.linspace(math.log(1e9), math.log(2e13), 800)
    radius_mpc = np.cbrt(3.0 * np.exp(ln_mass) / (4.0 * math.pi * COSMOLOGY.mean_density_msun_mpc3))
    ln_sigma = np.log(top_hat_sigma(SPECTRUM, radius_mpc * COSMOLOGY.h))
    variance = SharpKVariance(ln_mass, 2.0 * ln_sigma, -np.gradient(ln_sigma, ln_mass))
    clocks = float(COSMOLOGY.collapse_clock(0.0)), float(COSMOLOGY.collapse_clock(dz))
    trees = grown(root, 4e-4 * root, branching, 1000, 4, grow_all_orders, variance, clocks, factor=1.0)
    share = [
        np.histogram(np.log10(tree.m_end_msun / root), edges, weights=tree.m_end_msun / root)[0] for tree in trees
    ]

    ln_x = math.log(10.0) * np.linspace(edges[0], edges[-1], 4001)
    ln_nu = math.log(clocks[1] - clocks[0]) - 0.5 * np.log(
        variance.variance(root * np.exp(ln_x)) - variance.variance(np.array(root))
    )
    density = 0.4 * np.exp(0.75 * ln_nu - 0.1 * np.exp(3.0 * ln_nu)) * np.gradient(ln_nu, ln_x)
    expected = [np.trapezoid(density[i : i + 501], ln_x[i : i + 501]) for i in range(0, 4000, 500)]
    return Mean.of(share).excess(np.array(expected), 0.2)


@pytest.mark.parametrize(("dz", "wrong"), [(0.5, TOO_SLOW), (1.0, WRONG_SIGN), (2.0, WRONG_SIGN)])
def test_conditional_mass_function_agrees_with_cole_2008(dz, wrong):
    assert conditional_excess(dz, PCH08) < 1.0
    assert conditional_excess(dz, wrong) > 1.0


# The algorithm of the appendix of Parkinson, Cole & Helly 2008, which shares no code with the tables: a power
# law above the branching rate, from which progenitors are drawn and accepted by the ratio of the two.


@njit(cache=True)
def _look_up(x, grid, values):
    """Linear interpolation on an equally spaced grid."""
    position = (x - grid[0]) / (grid[1] - grid[0])
    i = min(max(int(position), 0), grid.size - 2)
    return values[i] + (position - i) * (values[i + 1] - values[i])


@njit(cache=True)
def _envelope_walk(rng, clock, clock_end, root, resolution, ln_mass, ln_s, slope, ln_u, ln_j, branching, factor):
    g0, gamma1, gamma2, gamma3 = branching
    norm = math.sqrt(2.0 / math.pi)
    masses = np.empty(200_000)
    n_masses = 0
    mass = root
    while mass > 2.0 * resolution:
        s2 = math.exp(_look_up(math.log(mass), ln_mass, ln_s))
        s_half = math.exp(_look_up(math.log(0.5 * mass), ln_mass, ln_s))
        s_res = math.exp(_look_up(math.log(resolution), ln_mass, ln_s))
        if s_half - s2 < 1e-10 * s2 or s_res - s2 < 1e-10 * s2:
            break
        slope_half = _look_up(math.log(0.5 * mass), ln_mass, slope)
        q_res = resolution / mass
        v_half, v_res = s_half / (s_half - s2) ** 1.5, s_res / (s_res - s2) ** 1.5
        beta = math.log(v_res / v_half) / math.log(2.0 * q_res)
        big_b = 2.0**beta * v_half
        mu = slope_half if gamma1 >= 0.0 else -0.5 * math.log(s_res / s_half) / math.log(2.0 * q_res)
        eta = beta - 1.0 - gamma1 * mu
        time = (factor * clock / math.sqrt(s2)) ** gamma2
        upper = norm * big_b * slope_half * g0 * 2.0 ** (-mu * gamma1) * time * (s_half / s2) ** (0.5 * gamma1)
        upper *= (0.5**eta - q_res**eta) / eta
        d_omega = min(0.1 * math.sqrt(2.0 * (s_half - s2)), 0.1 / upper)
        j = math.exp(_look_up(0.5 * math.log(s2 / (s_res - s2)), ln_u, ln_j))
        accreted = min(0.5, norm * j * g0 / math.sqrt(s2) * time * d_omega)
        clock += d_omega / factor
        if clock > clock_end:
            break
        left = mass * (1.0 - accreted)
        if rng.random() < upper * d_omega:
            q = (q_res**eta + (0.5**eta - q_res**eta) * rng.random()) ** (1.0 / eta)
            s1 = math.exp(_look_up(math.log(q * mass), ln_mass, ln_s))
            accept = _look_up(math.log(q * mass), ln_mass, slope) / slope_half
            accept *= s1 / (s1 - s2) ** 1.5 / (big_b * q**beta)
            accept *= ((2.0 * q) ** mu * math.sqrt(s1 / s_half)) ** gamma1 * (1.0 - s2 / s1) ** gamma3
            if rng.random() < accept:
                one, other = q * mass, left - q * mass
                left = max(one, other)
                if min(one, other) > resolution:
                    masses[n_masses] = min(one, other)
                    n_masses += 1
        mass = left
    return masses[:n_masses]


def envelope_trees(variance, root, resolution, branching, n_trees, seed):
    """Accreted masses of each tree; J(u) is integrated numerically."""
    ln_u = np.linspace(math.log(1e-4), math.log(1e5), 40_001)
    u = np.exp(ln_u)
    integrand = u * (1.0 + u**-2) ** (0.5 * branching[1]) * (1.0 + u**2) ** -branching[3]
    steps = 0.5 * (integrand[1:] + integrand[:-1]) * np.diff(ln_u)
    first = integrand[0] / (1.0 - branching[1])
    ln_j = np.log(first + np.concatenate(([0.0], np.cumsum(steps))))
    ln_mass = np.linspace(math.log(0.9 * resolution), math.log(1.1 * root), 2000)
    ln_s, slope = np.log(variance.variance(np.exp(ln_mass))), variance.log_slope(np.exp(ln_mass))
    rng = np.random.default_rng(seed)
    arguments = (*CLOCKS, root, resolution, ln_mass, ln_s, slope, ln_u, ln_j, branching, 1.197)
    return (_envelope_walk(rng, *arguments) for _ in range(n_trees))


@pytest.mark.parametrize(("branching", "m_th_kev"), [("pch08", math.inf), ("pch_plus", math.inf), ("pch08", 3.3)])
def test_tables_and_envelope_give_the_same_mass_function(branching, m_th_kev):
    root, resolution, n_trees = 1e13, 10**9.5, 2000
    edges = np.linspace(-3.5, -0.3, 7)
    variance = variance_of(m_th_kev)
    parameters = BRANCHING[branching]
    envelope = Mean.of(
        [count(m, root, edges) for m in envelope_trees(variance, root, resolution, parameters, n_trees, 5)]
    )

    def excess(rates):
        trees = grown(root, resolution, rates, n_trees, 6, grow_tree, variance)
        table = Mean.of([count(tree.m_acc_msun, root, edges) for tree in trees])
        both = Mean(table.value, np.hypot(table.error, envelope.error))
        return both.excess(envelope.value, 0.02)

    assert excess(parameters) < 1.0
    assert excess((parameters[0], -parameters[1], *parameters[2:])) > 1.0


# Unevolved mass function of warm over that of cold dark matter: between the fits of Lovell et al. 2014
# (subhalos), / 1.3, and Schneider et al. 2012 (halos), * 1.15, above 0.3 M_hm; within 2.5 of the former for
# 0.09 < m/M_hm < 1, and far below it further down, where the sharp-k variance has no power left.


EDGES = np.arange(7.5, 11.1, 0.5)  # log10(m_acc/Msun)


@pytest.fixture(scope="module")
def unevolved():
    """Mean accreted halos a host of 1e13 Msun in bins of `EDGES`, by particle mass."""
    means = {}
    for m_th_kev, n_trees in ((1.0, 1000), (2.0, 1000), (3.3, 500), (math.inf, 80)):
        model = dark_matter(m_th_kev, COSMOLOGY)
        resolution = max(model.resolution_msun, 10**7.5)
        trees = grown(
            1e13, resolution, PCH08, n_trees, 7, grow_tree, variance_of(m_th_kev), ratio=model.barrier_ratio
        )
        means[m_th_kev] = Mean.of([np.histogram(np.log10(tree.m_acc_msun), EDGES)[0] for tree in trees])
    return means


def lies_between_fits(m_th_kev, half_mode_mass_msun, unevolved):
    warm, cold = unevolved[m_th_kev], unevolved[math.inf]
    ratio = warm.value / cold.value
    error = np.hypot(warm.error, ratio * cold.error) / cold.value
    resolved = EDGES[:-1] >= math.log10(dark_matter(m_th_kev, COSMOLOGY).resolution_msun)
    x = 10 ** (0.5 * (EDGES[1:] + EDGES[:-1])) / half_mode_mass_msun
    lovell14, schneider12 = (1 + 2.7 / x) ** -0.99, (1 + 1 / x) ** -0.6
    high, middle, low = x > 0.3, (x > 0.09) & (x < 1.0), x < 0.03
    return bool(
        np.all(ratio[high] + 3 * error[high] > lovell14[high] / 1.3)
        and np.all(ratio[high] - 3 * error[high] < 1.15 * schneider12[high])
        and np.all(ratio[middle] + 3 * error[middle] > lovell14[middle] / 2.5)
        and np.all(ratio[middle] - 3 * error[middle] < 2.5 * lovell14[middle])
        and np.all(ratio[low & resolved] - 3 * error[low & resolved] < lovell14[low & resolved] / 4.0)
    )


@pytest.mark.parametrize(("m_th_kev", "wrong_kev"), [(1.0, 2.0), (2.0, 3.3), (2.0, 1.0), (3.3, 2.0)])
def test_warm_suppression_lies_between_published_fits(m_th_kev, wrong_kev, unevolved):
    half_mode = {kev: dark_matter(kev, COSMOLOGY).half_mode_mass_msun for kev in (m_th_kev, wrong_kev)}
    assert lies_between_fits(m_th_kev, half_mode[m_th_kev], unevolved)
    assert not lies_between_fits(m_th_kev, half_mode[wrong_kev], unevolved)
