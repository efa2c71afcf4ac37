"""Truncated NFW profiles of drawn subhalos against lenstronomy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from warmlens.cosmology import Cosmology, LensGeometry
from warmlens.halos.lens_halo import HaloGenerator, HaloModel
from warmlens.lensing.deflection import TnfwHalos, tnfw_angular_scales, tnfw_deflection


def test_deflection_of_drawn_subhalos_agrees_with_lenstronomy():
    from lenstronomy.LensModel.Profiles.tnfw import TNFW

    geometry = LensGeometry.from_redshifts(Cosmology(), 0.295, 0.658)
    generator = HaloGenerator(Cosmology(), geometry, HaloModel(min_mass_msun=1e9))
    subhalos = generator.draw(3.0, 1e13, 1e4, np.random.default_rng(1)).subhalos
    scale, sigma = geometry.kpc_per_arcsec, geometry.sigma_crit_msun_kpc2
    assert subhalos.m_bound.size >= 10
    theta_in_r_s = np.geomspace(0.01, 30.0, 20)
    for r_s, rho_s, r_t in zip(subhalos.r_s_kpc, subhalos.rho_s, subhalos.r_t_kpc, strict=True):
        theta = theta_in_r_s * r_s / scale
        scales = tnfw_angular_scales([r_s], [r_t], [rho_s], scale, sigma)
        deflection = tnfw_deflection(theta, np.zeros_like(theta), TnfwHalos([0.0], [0.0], *scales))[0]
        alpha_rs = 4.0 * rho_s * r_s**2 * (1.0 - math.log(2.0)) / sigma / scale
        expected = TNFW().derivatives(theta, np.zeros_like(theta), r_s / scale, alpha_rs, r_t / scale)[0]
        assert deflection == pytest.approx(expected, rel=3e-6)  # the table of the deflection: 2e-6
