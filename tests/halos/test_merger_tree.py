from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import kstest

from warmlens.halos.dark_matter import dark_matter
from warmlens.halos.merger_tree import BRANCHING, branching_table, grow_tree, smooth_integral
from warmlens.halos.power_spectrum import filtered_variance

from .all_orders import grow_all_orders

PCH08 = BRANCHING["pch08"]
ROOT = 1e13


@pytest.fixture(scope="module")
def clocks(cosmology):
    return float(cosmology.collapse_clock(0.295)), float(cosmology.collapse_clock(20.0))


@pytest.fixture(scope="module")
def variance_of(cosmology, spectrum):
    return lambda m_th_kev: filtered_variance(dark_matter(m_th_kev, cosmology).transfer, spectrum, cosmology, 2.5)


def table_of(variance, resolution, branching=PCH08, barrier_ratio=np.ones_like):
    return branching_table(variance, ROOT, resolution, branching, 1.197, barrier_ratio)


def test_published_parameters():
    assert BRANCHING["pch08"] == (0.57, 0.38, -0.01, 0.0)  # Parkinson, Cole & Helly 2008
    assert BRANCHING["benson17"] == (0.6353, 0.1761, 0.0411, 0.0)  # Benson 2017
    assert BRANCHING["pch_plus"] == (0.943, -0.158, 0.0488, 0.202)  # Benson et al. 2021


def test_smooth_integral_reference_values():
    values = smooth_integral(np.array([0.3, 1.0, 5.0, 50.0]), 0.38, 0.0)
    np.testing.assert_allclose(values, [0.767613, 1.673409, 5.806274, 50.84027], rtol=1e-6)


@pytest.mark.parametrize(("gamma1", "gamma3"), [(0.38, 0.0), (0.1761, 0.0), (-0.158, 0.202), (-0.3274, 0.6456)])
def test_smooth_integral_is_the_integral(gamma1, gamma3):
    for u in (0.2, 2.0, 30.0):
        direct = quad(lambda v: (1 + 1 / v**2) ** (gamma1 / 2) * (1 + v**2) ** -gamma3, 0.0, u)[0]
        assert smooth_integral(np.array([u]), gamma1, gamma3)[0] == pytest.approx(direct, rel=1e-7)


@pytest.mark.parametrize("branching", ["pch08", "pch_plus"])
@pytest.mark.parametrize("m_th_kev", [math.inf, 2.0])
def test_cumulative_branching_is_the_integral_of_the_rate(m_th_kev, branching, variance_of):
    variance = variance_of(m_th_kev)
    table = table_of(variance, 1e8, BRANCHING[branching])
    g0, gamma1, _, gamma3 = BRANCHING[branching]
    for row in (511, 300, 60):
        parent = 2e8 * math.exp(row * table.step)
        s2 = float(variance.variance(np.array(parent)))

        def rate(ln_mass, parent=parent, s2=s2):
            mass = np.exp(ln_mass)
            s1 = variance.variance(mass)
            g = g0 * (s1 / s2) ** (gamma1 / 2) * (1 - s2 / s1) ** gamma3
            shape = s1 / (s1 - s2) ** 1.5 * variance.log_slope(mass)
            return math.sqrt(2 / math.pi) * shape * parent / mass * g

        for share in (0.5, 1.0):
            top = int(share * row)
            grid = np.linspace(math.log(1e8), math.log(1e8) + top * table.step, 20_001)
            direct = np.trapezoid(rate(grid), grid)
            assert table.cumulative[row, top] == pytest.approx(direct, rel=1e-3)


def test_rates_of_a_short_time_are_those_of_the_table(variance_of, clocks):
    # 20,000 trees over a time in which every third branches: number, masses and smooth loss
    table = table_of(variance_of(math.inf), 1e10)
    b, sigma = table.barrier[-1], table.sigma[-1]
    factor = (b * clocks[0] / sigma) ** table.gamma2
    rate = table.cumulative[-1, -1] * factor
    rng = np.random.default_rng(11)
    trees = [grow_tree(table, clocks[0], clocks[0] + 0.3 / (rate * b), rng) for _ in range(20_000)]

    omega = b * np.array([tree.trunk_clock[-1] - clocks[0] for tree in trees])
    counts = np.array([tree.m_acc_msun.size for tree in trees])
    expected = rate * omega.sum()
    assert counts.sum() == pytest.approx(expected, rel=0.03)

    mass = np.concatenate([tree.m_acc_msun for tree in trees])
    ln_nodes = math.log(1e10) + table.step * np.arange(512)
    cumulative = table.cumulative[-1] / table.cumulative[-1, -1]
    assert kstest(np.log(mass), lambda x: np.interp(x, ln_nodes, cumulative)).pvalue > 0.01
    assert kstest(np.log(1.1 * mass), lambda x: np.interp(x, ln_nodes, cumulative)).pvalue < 1e-6

    alone = counts == 0
    smooth = np.array([math.log(t.trunk_mass_msun[0] / t.trunk_mass_msun[-1]) for t in trees])
    assert smooth[alone].sum() == pytest.approx(table.smooth[-1] * factor * omega[alone].sum(), rel=0.02)


@pytest.mark.parametrize("m_th_kev", [math.inf, 2.0])
def test_tree_is_a_history(m_th_kev, variance_of, clocks):
    table = table_of(variance_of(m_th_kev), 1e8, barrier_ratio=lambda mass: 1.0 + (2e7 / mass) ** 0.8)
    tree = grow_tree(table, *clocks, np.random.default_rng(2))
    assert tree.trunk_mass_msun[0] == pytest.approx(ROOT, rel=1e-12)
    assert tree.trunk_clock[0] == clocks[0]
    assert np.all(np.diff(tree.trunk_clock) > 0)
    assert np.all(np.diff(tree.trunk_mass_msun) <= 0)
    assert tree.m_acc_msun.size > 50
    assert np.all(tree.m_acc_msun > 1e8)
    assert np.all(tree.m_acc_msun <= tree.host_mass_msun)
    assert np.all((tree.clock_acc > clocks[0]) & (tree.clock_acc <= clocks[1]))
    assert np.all(np.diff(tree.clock_acc) > 0)
    # what the trunk accreted and what it had at the end is what it has at the root
    assert tree.smooth_mass_msun > 0
    total = tree.m_acc_msun.sum() + tree.smooth_mass_msun + tree.trunk_mass_msun[-1]
    assert total == pytest.approx(ROOT, rel=1e-11)
    # the trunk is stored often enough to hold the host of every accretion
    stored = np.exp(np.interp(tree.clock_acc, tree.trunk_clock, np.log(tree.trunk_mass_msun)))
    np.testing.assert_allclose(stored, tree.host_mass_msun, rtol=1.1e-3)


def test_barrier_is_the_factor_times_the_ratio_at_the_parent(variance_of):
    table = table_of(variance_of(math.inf), 1e9, barrier_ratio=lambda mass: 1.0 + 1e10 / mass)
    parent = 2e9 * np.exp(table.step * np.arange(512))
    np.testing.assert_allclose(table.barrier, 1.197 * (1.0 + 1e10 / parent), rtol=1e-12)


def test_a_step_accretes_at_most_half_of_the_mass_smoothly(variance_of, clocks):
    # at 20 times the published rate the criteria of barrier and branching alone allow 1.7 times all of it
    table = table_of(variance_of(math.inf), 1e10, (20 * 0.57, *PCH08[1:]))
    assert np.max(table.smooth * table.max_step) > 1.0
    for seed in range(200):
        tree = grow_tree(table, *clocks, np.random.default_rng(seed))
        total = tree.m_acc_msun.sum() + tree.smooth_mass_msun + tree.trunk_mass_msun[-1]
        assert total == pytest.approx(ROOT, rel=1e-12)
        assert tree.trunk_mass_msun[-1] >= 1e10 * (1 - 1e-12)


@pytest.fixture(scope="module")
def all_orders(variance_of, clocks):
    table = table_of(variance_of(math.inf), 1e8)
    return grow_all_orders(table, *clocks, np.random.default_rng(5))


def test_all_order_tree_is_a_family(all_orders, clocks):
    tree = all_orders
    assert tree.order[0] == 0
    assert tree.parent[0] == -1
    assert tree.m_acc_msun[0] == pytest.approx(ROOT, rel=1e-12)
    assert tree.clock_acc[0] == clocks[0]
    assert math.isnan(tree.host_mass_msun[0])
    child, parent = np.arange(1, tree.order.size), tree.parent[1:]
    assert np.all(parent < child)
    assert tree.order.max() >= 5
    np.testing.assert_array_equal(tree.order[1:], tree.order[parent] + 1)
    assert np.all(tree.m_acc_msun > 1e8)
    assert np.all(tree.clock_acc[1:] > tree.clock_acc[parent])  # into the past
    assert np.all(tree.clock_acc <= clocks[1])
    assert np.all(tree.m_acc_msun[1:] <= tree.host_mass_msun[1:])
    assert np.all(tree.host_mass_msun[1:] + tree.m_acc_msun[1:] <= tree.m_acc_msun[parent] * (1 + 1e-12))
    assert np.all(tree.m_end_msun <= tree.m_acc_msun * (1 + 1e-12))


def test_every_branch_conserves_mass(all_orders):
    tree = all_orders
    accreted = np.bincount(tree.parent[1:], tree.m_acc_msun[1:], tree.order.size)
    total = tree.m_end_msun + tree.smooth_mass_msun + accreted
    np.testing.assert_allclose(total, tree.m_acc_msun, rtol=1e-11)
    # what was accreted below the resolution and what is left at the end of the branches is the root
    assert tree.m_end_msun.sum() + tree.smooth_mass_msun.sum() == pytest.approx(ROOT, rel=1e-11)


def test_first_order_of_all_orders_is_the_trunk_of_the_same_seed(variance_of, clocks):
    table = table_of(variance_of(math.inf), 1e10)  # its trunk ends before z = 20
    for seed in range(5):
        trunk = grow_tree(table, *clocks, np.random.default_rng(seed))
        tree = grow_all_orders(table, *clocks, np.random.default_rng(seed))
        assert trunk.trunk_clock[-1] < 0.9 * clocks[1]
        for name in ("m_acc_msun", "host_mass_msun", "clock_acc"):
            np.testing.assert_array_equal(getattr(tree, name)[tree.order == 1], getattr(trunk, name))


def test_branches_end_at_the_given_time(variance_of, clocks):
    # a time far shorter than a step: nothing but smooth accretion at the rate of the table
    table = table_of(variance_of(math.inf), 1e10)
    later = clocks[0] + 1e-6
    tree = grow_all_orders(table, clocks[0], later, np.random.default_rng(0))
    d_omega = table.barrier[-1] * 1e-6
    time_factor = (table.barrier[-1] * clocks[0] / table.sigma[-1]) ** table.gamma2
    assert tree.order.size == 1
    assert tree.smooth_mass_msun[0] / ROOT == pytest.approx(table.smooth[-1] * time_factor * d_omega, rel=1e-6)


def test_half_mass_is_where_the_trunk_has_it(variance_of, clocks):
    tree = grow_tree(table_of(variance_of(math.inf), 1e9), *clocks, np.random.default_rng(2))
    at_half = np.interp(tree.half_mass_clock, tree.trunk_clock, np.log(tree.trunk_mass_msun))
    assert math.exp(at_half) == pytest.approx(0.5 * ROOT, rel=1e-9)


def test_same_seed_same_tree_and_the_generator_advances(variance_of, clocks):
    table = table_of(variance_of(2.0), 1e8)
    rng = np.random.default_rng(7)
    first, second = grow_tree(table, *clocks, rng), grow_tree(table, *clocks, rng)
    again = grow_tree(table, *clocks, np.random.default_rng(7))
    np.testing.assert_array_equal(first.m_acc_msun, again.m_acc_msun)
    np.testing.assert_array_equal(first.trunk_mass_msun, again.trunk_mass_msun)
    assert first.steps == again.steps
    assert not np.array_equal(first.m_acc_msun, second.m_acc_msun)


def test_monolithic_collapse_has_no_progenitors(variance_of, clocks):
    # 1e5 Msun at 0.3 keV: no variance is left below the parent
    table = branching_table(variance_of(0.3), 1e5, 1e3, PCH08, 1.197, np.ones_like)
    tree = grow_tree(table, *clocks, np.random.default_rng(1))
    assert tree.m_acc_msun.size == 0
    assert tree.smooth_mass_msun == 0.0
    assert tree.steps == 0
    np.testing.assert_array_equal(tree.trunk_mass_msun, tree.trunk_mass_msun[:1])


def test_impossible_parameters_are_errors(variance_of):
    with pytest.raises(ValueError, match="root_mass_msun must exceed twice resolution_msun"):
        branching_table(variance_of(math.inf), 1e9, 5e8, PCH08, 1.197, np.ones_like)
    with pytest.raises(ValueError, match=r"gamma1 of branching must be < 1, got 1\.0"):
        table_of(variance_of(math.inf), 1e9, branching=(0.57, 1.0, 0.0, 0.0))
