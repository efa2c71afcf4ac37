from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from warmlens.lensing.deflection import TnfwHalos, tnfw_angular_scales, tnfw_convergence, tnfw_deflection

ONE = TnfwHalos(*(np.array([value]) for value in (0.3, -0.2, 0.1, 0.5, 2e-3)))


def many(n: int, seed: int = 1) -> TnfwHalos:
    rng = np.random.default_rng(seed)
    r_s = 10 ** rng.uniform(-2, 0, n)
    return TnfwHalos(
        center_x=rng.uniform(-3, 3, n),
        center_y=rng.uniform(-3, 3, n),
        r_s_arcsec=r_s,
        r_t_arcsec=r_s * 10 ** rng.uniform(-1, 1.5, n),
        alpha_scale=10 ** rng.uniform(-4, -2, n),
    )


def surface_density(x: float, tau: float) -> float:
    """Line-of-sight integral of the profile, in units of rho_s r_s."""

    def rho(log_z: float) -> float:
        z = np.exp(log_z)
        r = np.hypot(x, z)
        return z * 2.0 / (r * (1.0 + r) ** 2) * tau**2 / (tau**2 + r**2)

    return quad(rho, np.log(1e-9 * x), np.log(1e5), epsabs=0, epsrel=1e-10, limit=500)[0]


@pytest.mark.parametrize("tau", [0.2, 1.0, 5.0, 30.0])
def test_convergence_is_the_line_of_sight_integral(tau):
    one = ONE._replace(r_t_arcsec=ONE.r_s_arcsec * tau)
    x = np.array([1e-3, 0.1, 0.95, 0.999, 1.0, 1.001, 1.05, 3.0, 40.0])
    kappa = tnfw_convergence(0.3 + 0.1 * x, np.full(x.size, -0.2), one)
    # kappa = Sigma / Sigma_cr with Sigma = rho_s r_s * integral and alpha_scale = 4 rho_s r_s^2 / Sigma_cr
    expected = 2e-3 / (4.0 * 0.1) * np.array([surface_density(value, tau) for value in x])
    np.testing.assert_allclose(kappa, expected, rtol=1e-6)


@pytest.mark.parametrize("tau", [0.2, 1.0, 5.0, 30.0])
def test_deflection_is_the_mean_convergence_inside(tau):
    one = ONE._replace(r_t_arcsec=ONE.r_s_arcsec * tau)
    for x in (1e-3, 0.5, 1.0, 4.0, 60.0):
        inside = quad(
            lambda u: np.exp(2 * u) * surface_density(np.exp(u), tau), np.log(x) - 14, np.log(x), epsrel=1e-8
        )[0]
        alpha = tnfw_deflection([0.3 + 0.1 * x], [-0.2], one)
        assert alpha[0, 0] == pytest.approx(2e-3 / 4.0 * 2.0 * inside / x, rel=3e-5)
        assert alpha[1, 0] == 0.0


def test_divergence_of_the_deflection_is_twice_the_convergence():
    subhalos = many(20)
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-3, 3, (2, 200))
    step = 2e-3
    shifted_x = tnfw_deflection(np.stack([x + step, x - step]), np.stack([y, y]), subhalos)[0]
    shifted_y = tnfw_deflection(np.stack([x, x]), np.stack([y + step, y - step]), subhalos)[1]
    divergence = (shifted_x[0] - shifted_x[1] + shifted_y[0] - shifted_y[1]) / (2 * step)
    kappa = tnfw_convergence(x, y, subhalos)
    assert np.median(np.abs(divergence / (2 * kappa) - 1)) < 1e-3


def test_far_away_it_is_a_point_mass_of_the_total_mass():
    kpc_per_arcsec, sigma_crit, r_s, rho_s = 4.432263, 3.60394e9, 0.8, 2e7
    scales = tnfw_angular_scales([r_s], [5.0 * r_s], [rho_s], kpc_per_arcsec, sigma_crit)
    theta = 4000.0
    alpha = tnfw_deflection([0.6 * theta], [0.8 * theta], TnfwHalos([0.0], [0.0], *scales))
    mass = 4.0 * np.pi * rho_s * r_s**3 * 1.0478725  # mu(5)
    distance_kpc = theta * kpc_per_arcsec
    expected = mass / (np.pi * sigma_crit * distance_kpc) / kpc_per_arcsec
    np.testing.assert_allclose(alpha[:, 0], expected * np.array([0.6, 0.8]), rtol=3e-3)


def test_centre_is_exactly_zero_and_its_surroundings_are_linear():
    theta = np.array([0.0, 1e-7, 2e-7])
    alpha = tnfw_deflection(0.3 + theta, np.full(3, -0.2), ONE)
    assert (alpha[:, 0] == 0.0).all()
    assert alpha[0, 2] == pytest.approx(2 * alpha[0, 1], rel=1e-8)
    assert alpha[0, 1] > 0.0


def test_sum_over_subhalos_is_the_sum_of_each():
    subhalos = many(5)
    x, y = np.meshgrid(np.linspace(-2, 2, 7), np.linspace(-1, 1, 4))
    total = tnfw_deflection(x, y, subhalos)
    each = [tnfw_deflection(x, y, TnfwHalos(*(array[k : k + 1] for array in subhalos))) for k in range(5)]
    assert total.shape == (2, 4, 7)
    np.testing.assert_allclose(total, np.sum(each, axis=0), rtol=1e-12)


def test_no_subhalo_and_no_ray():
    none = TnfwHalos(*[np.empty(0)] * 5)
    np.testing.assert_array_equal(tnfw_deflection(np.ones((2, 3)), np.ones((2, 3)), none), np.zeros((2, 2, 3)))
    assert tnfw_deflection(np.empty(0), np.empty(0), ONE).shape == (2, 0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("center_x", np.nan),
        ("r_s_arcsec", 0.0),
        ("r_t_arcsec", -1.0),
        ("r_t_arcsec", 0.0),
        ("r_t_arcsec", np.inf),
        ("alpha_scale", np.nan),
        ("alpha_scale", -1e-3),
    ],
)
@pytest.mark.parametrize("function", [tnfw_deflection, tnfw_convergence])
def test_bad_subhalos_are_refused_by_name(function, name, value):
    with pytest.raises(ValueError, match=rf"{name}\[0\]"):
        function([0.0], [0.0], ONE._replace(**{name: np.array([value])}))


def test_bad_rays_and_shapes_are_refused():
    with pytest.raises(ValueError, match="finite"):
        tnfw_deflection([np.nan], [0.0], ONE)
    with pytest.raises(ValueError, match="one shape"):
        tnfw_deflection([0.0, 1.0], [0.0], ONE)
    with pytest.raises(ValueError, match="r_s_arcsec has shape"):
        tnfw_deflection([0.0], [0.0], ONE._replace(r_s_arcsec=np.ones(2)))
    with pytest.raises(ValueError, match="sigma_crit"):
        tnfw_angular_scales([1.0], [1.0], [1.0], 4.4, 0.0)
