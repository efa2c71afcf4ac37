from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import beta, kstest

from warmlens.halos.stripping import TidalField, draw_circularity, friction_ln_a, loss_per_efold

A_TS, ZETA = 1.54, 0.07
LN_A_LENS = -math.log(1.295)


def constant_host(ln_mass, cosmology, tau_dyn="paper", slope=ZETA):
    ln_a = np.array([-math.log(21.0), LN_A_LENS])
    return TidalField.of_host(ln_a, np.full(2, ln_mass), A_TS, slope, tau_dyn, cosmology)


def test_loss_coefficients(cosmology):
    z = np.array([0.0, 0.295, 2.0])
    np.testing.assert_allclose(loss_per_efold(z, A_TS, "paper", cosmology), 15.4)
    virial = cosmology.virial_overdensity(z)
    expected = 9.25 * np.sqrt(virial / 178.0)
    np.testing.assert_allclose(loss_per_efold(z, A_TS, "jvdb16", cosmology), expected, rtol=1e-3)


def test_jvdb16_time_is_1_628_gyr_over_h(cosmology):
    # Jiang & van den Bosch 2016, eq. 2: tau = 1.628/h Gyr (Delta/178)^-1/2 (H/H0)^-1
    tau_gyr = 1.628 / cosmology.h * (cosmology.virial_overdensity(0.5) / 178.0) ** -0.5
    tau_gyr = tau_gyr / cosmology.expansion(0.5)
    hubble_per_gyr = cosmology.expansion(0.5) * cosmology.H0 / 977.792
    expected = A_TS / (tau_gyr * hubble_per_gyr)
    assert loss_per_efold(np.array(0.5), A_TS, "jvdb16", cosmology) == pytest.approx(expected, rel=1e-3)


def test_constant_host_reference_value(cosmology):
    left = constant_host(math.log(1e13), cosmology).bound_mass(np.array([1e10]), np.array([-math.log(3.0)]))
    assert left[0] / 1e10 == pytest.approx(0.00176774, rel=1e-5)


@pytest.mark.parametrize(
    ("tau_dyn", "fractions"), [("paper", [0.3195, 0.0433, 0.0039]), ("jvdb16", [0.5464, 0.1683, 0.0345])]
)
def test_constant_host_reference_table(tau_dyn, fractions, cosmology):
    ln_a = -np.log1p([0.5, 1.0, 2.0])
    left = constant_host(math.log(1e13), cosmology, tau_dyn).bound_mass(np.full(3, 1e9), ln_a)
    np.testing.assert_allclose(left / 1e9, fractions, rtol=2e-3, atol=6e-5)


def test_power_law_host_has_a_closed_form(cosmology):
    power, root = 1.7, 1e13
    ln_a = np.linspace(-math.log(21.0), LN_A_LENS, 4000)
    ln_host = math.log(root) + power * (ln_a - LN_A_LENS)
    field = TidalField.of_host(ln_a, ln_host, A_TS, ZETA, "paper", cosmology)
    ln_acc = np.array([-1.5, -1.0, -0.5])
    m_acc = np.array([1e7, 1e9, 1e11])
    host_acc = np.exp(np.interp(ln_acc, ln_a, ln_host))
    exact = (m_acc**-ZETA + 15.4 / power * (host_acc**-ZETA - root**-ZETA)) ** (-1 / ZETA)
    np.testing.assert_allclose(field.bound_mass(m_acc, ln_acc), exact, rtol=1e-4)


def test_small_slope_tends_to_exponential_decay(cosmology):
    field = constant_host(math.log(1e13), cosmology, slope=1e-7)
    left = field.bound_mass(np.array([1e9]), np.array([-0.5]))
    assert left[0] / 1e9 == pytest.approx(math.exp(-15.4 * (LN_A_LENS + 0.5)), rel=1e-4)


def test_agrees_with_the_differential_equation(cosmology):
    knots = np.array([-2.5, -1.8, -1.2, -0.9, LN_A_LENS])
    ln_host = np.log([1e10, 3e11, 8e11, 4e12, 1e13])
    field = TidalField.of_host(knots, ln_host, A_TS, ZETA, "jvdb16", cosmology)

    def rate(ln_a, ln_m):
        k = loss_per_efold(np.expm1(-ln_a), A_TS, "jvdb16", cosmology)
        return -k * np.exp(ZETA * (ln_m - np.interp(ln_a, knots, ln_host)))

    solution = solve_ivp(rate, (-1.5, LN_A_LENS), [math.log(1e9)], rtol=1e-9, max_step=0.01)
    left = field.bound_mass(np.array([1e9]), np.array([-1.5]))
    assert math.log(left[0]) == pytest.approx(solution.y[0, -1], abs=1e-4)


def test_no_time_no_loss(cosmology):
    left = constant_host(math.log(1e13), cosmology).bound_mass(np.array([1e9]), np.array([LN_A_LENS]))
    assert left[0] == pytest.approx(1e9, rel=1e-12)


def test_unknown_options_are_errors(cosmology):
    with pytest.raises(ValueError, match='tau_dyn must be "paper" or "jvdb16", got'):
        loss_per_efold(np.array([1.0]), A_TS, "other", cosmology)
    with pytest.raises(ValueError, match=r"stripping_slope must be > 0, got 0\.0"):
        constant_host(30.0, cosmology, slope=0.0)


def test_friction_reference_value():
    ln_a = friction_ln_a(np.array([-math.log(2.0)]), np.array([10.0]), np.array([0.5]), 0.216, 1.3, 1.9)
    assert 10 * (ln_a[0] + math.log(2.0)) == pytest.approx(4.647, abs=1e-3)
    assert math.exp(ln_a[0]) == pytest.approx(0.796, abs=1e-3)


@pytest.mark.parametrize(("z_acc", "ratio"), [(0.5, 2.51), (1.0, 9.30), (2.0, 18.6), (3.0, 25.1)])
def test_friction_removes_heavier_subhalos(z_acc, ratio):
    ratios = ratio * np.array([0.99, 1.01])
    ln_a = friction_ln_a(np.full(2, -math.log1p(z_acc)), ratios, np.full(2, 0.5), 0.216, 1.3, 1.9)
    assert ln_a[0] < LN_A_LENS < ln_a[1]


def test_friction_of_tiny_subhalos_does_not_overflow():
    ln_a = friction_ln_a(np.array([-1.0]), np.array([1e9]), np.array([1.0]), 0.216, 1.3, 1.9)
    assert np.isfinite(ln_a[0])


def test_circularities_follow_zentner_2005():
    eta = draw_circularity(200_000, np.random.default_rng(1))
    assert eta.mean() == pytest.approx(0.5, abs=2e-3)
    assert eta.std() == pytest.approx(0.21437, abs=2e-3)
    np.testing.assert_allclose(
        np.percentile(eta, [5, 16, 50, 84, 95]), [0.1494, 0.2655, 0.5, 0.7345, 0.8506], atol=4e-3
    )
    assert kstest(eta, beta(2.22, 2.22).cdf).pvalue > 0.01
    assert kstest(eta, beta(2.12, 2.12).cdf).pvalue < 1e-4
