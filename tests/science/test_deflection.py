"""Deflection of truncated NFW subhalos against lenstronomy."""

from __future__ import annotations

import time

import numpy as np
import pytest
from lenstronomy.LensModel.lens_model import LensModel
from lenstronomy.LensModel.Profiles.tnfw import TNFW

from warmlens.lensing.deflection import TnfwHalos, tnfw_angular_scales, tnfw_convergence, tnfw_deflection

KPC_PER_ARCSEC, SIGMA_CRIT = 4.432263, 3.60394e9


def population(n: int, tau: np.ndarray, seed: int) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-2.5, 2.5, (2, n))
    r_s = 10 ** rng.uniform(-1.0, 0.6, n)
    rho_s = 10 ** rng.uniform(6.5, 8.0, n)
    return x, y, r_s, tau * r_s, rho_s


def on_sky(x, y, r_s, r_t, rho_s):
    return TnfwHalos(x, y, *tnfw_angular_scales(r_s, r_t, rho_s, KPC_PER_ARCSEC, SIGMA_CRIT))


def lenstronomy_sum(rays_x, rays_y, x, y, r_s, r_t, rho_s):
    deflection = np.zeros((2, rays_x.size))
    convergence = np.zeros(rays_x.size)
    # alpha_Rs of lenstronomy is the deflection of the *untruncated* profile at r_s
    alpha_rs = 4.0 * rho_s * r_s**2 * (1.0 - np.log(2.0)) / SIGMA_CRIT / KPC_PER_ARCSEC
    for k in range(x.size):
        kwargs = {
            "Rs": r_s[k] / KPC_PER_ARCSEC,
            "alpha_Rs": alpha_rs[k],
            "r_trunc": r_t[k] / KPC_PER_ARCSEC,
            "center_x": x[k],
            "center_y": y[k],
        }
        deflection += np.array(TNFW().derivatives(rays_x, rays_y, **kwargs))
        f_xx, _, _, f_yy = TNFW().hessian(rays_x, rays_y, **kwargs)
        convergence += 0.5 * (f_xx + f_yy)
    return deflection, convergence


@pytest.mark.parametrize("tau", [0.1, 0.7, 1.0, 2.0, 5.0, 30.0])
def test_one_truncation(tau):
    x, y, r_s, r_t, rho_s = population(4, np.full(4, tau), seed=5)
    rng = np.random.default_rng(6)
    near = 10 ** rng.uniform(-4, 0, (2, 300)) * rng.choice([-1, 1], (2, 300))
    far = rng.uniform(-60, 60, (2, 200))
    rays_x = np.concatenate([x[0] + near[0], far[0]])
    rays_y = np.concatenate([y[0] + near[1], far[1]])
    halos = on_sky(x, y, r_s, r_t, rho_s)
    deflection, convergence = lenstronomy_sum(rays_x, rays_y, x, y, r_s, r_t, rho_s)
    alpha = tnfw_deflection(rays_x, rays_y, halos)
    np.testing.assert_allclose(alpha, deflection, rtol=0, atol=1e-6 * np.abs(deflection).max())
    np.testing.assert_allclose(tnfw_convergence(rays_x, rays_y, halos), convergence, rtol=1e-5)


def test_a_field_of_subhalos_on_pixels():
    tau = 10 ** np.random.default_rng(8).uniform(-0.5, 1.2, 100)
    x, y, r_s, r_t, rho_s = population(100, tau, seed=9)
    axis = (np.arange(64) - 31.5) * 0.1
    rays_x, rays_y = (array.ravel() for array in np.meshgrid(axis, axis))
    deflection, _ = lenstronomy_sum(rays_x, rays_y, x, y, r_s, r_t, rho_s)
    alpha = tnfw_deflection(rays_x, rays_y, on_sky(x, y, r_s, r_t, rho_s))
    assert np.abs(alpha - deflection).max() < 1e-6 * np.abs(deflection).max()
    # failing twin: the difference is far above the tolerance when the truncation is 1% off
    wrong = tnfw_deflection(rays_x, rays_y, on_sky(x, y, r_s, 1.01 * r_t, rho_s))
    assert np.abs(wrong - deflection).max() > 1e-4 * np.abs(deflection).max()


def test_faster_than_lenstronomy_in_the_same_run():
    """Ten times and more for the same field, to 1e-3 of its peak."""
    x, y, r_s, r_t, rho_s = population(40, np.full(40, 4.0), seed=11)
    axis = (np.arange(224) - 111.5) * 0.05  # an image of 160 pixels and the filter's margin
    rays_x, rays_y = (array.ravel() for array in np.meshgrid(axis, axis))
    halos = on_sky(x, y, r_s, r_t, rho_s)
    tnfw_deflection(rays_x[:1], rays_y[:1], halos)  # compiles
    lens = LensModel(["TNFW"] * x.size)
    kwargs = [
        {
            "Rs": r_s[k] / KPC_PER_ARCSEC,
            "alpha_Rs": halos.alpha_scale[k] * (1.0 - np.log(2.0)),
            "r_trunc": r_t[k] / KPC_PER_ARCSEC,
            "center_x": x[k],
            "center_y": y[k],
        }
        for k in range(x.size)
    ]
    ours, theirs = [], []
    for _ in range(3):
        start = time.perf_counter()
        alpha = tnfw_deflection(rays_x, rays_y, halos)
        ours.append(time.perf_counter() - start)
        start = time.perf_counter()
        expected = np.array(lens.alpha(rays_x, rays_y, kwargs))
        theirs.append(time.perf_counter() - start)
    assert np.abs(alpha - expected).max() < 1e-3 * np.abs(expected).max()
    assert min(theirs) > 10.0 * min(ours)
