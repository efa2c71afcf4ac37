from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from lenstronomy.LensModel.Profiles.nfw import NFW

from warmlens.cosmology import Cosmology, LensGeometry
from warmlens.halos.lens_halo import Subhalos
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.deflection import TnfwHalos, tnfw_angular_scales, tnfw_deflection
from warmlens.lensing.high_pass import FilterKind, high_pass
from warmlens.lensing.substructure import (
    SmoothHost,
    convergence_map,
    filtered_deflection,
    required_half_width,
)

GEOMETRY = LensGeometry.from_redshifts(Cosmology(), 0.295, 0.658)
GRID = PixelGrid.centred((60, 60), 0.05)


def _subhalos(x: list[float], y: list[float]) -> Subhalos:
    n = len(x)
    one = np.ones(n)
    return Subhalos(
        m_bound=1e9 * one, m_acc=2e9 * one, z_acc=one, concentration=9.0 * one,
        r_max_kpc=2.2 * one, v_max_kms=30.0 * one, r_s_kpc=one, rho_s=1e7 * one, r_t_kpc=3.0 * one,
        x_arcsec=np.array(x), y_arcsec=np.array(y),
    )  # fmt: skip


def test_no_subhalos_no_deflection() -> None:
    assert not filtered_deflection(_subhalos([], []), GRID, GEOMETRY, 0.4).any()


def test_deflections_add_and_shift() -> None:
    both = filtered_deflection(_subhalos([0.1, -0.7], [0.2, 0.5]), GRID, GEOMETRY, 0.4)
    one = filtered_deflection(_subhalos([0.1], [0.2]), GRID, GEOMETRY, 0.4)
    other = filtered_deflection(_subhalos([-0.7], [0.5]), GRID, GEOMETRY, 0.4)
    np.testing.assert_allclose(both, one + other, atol=1e-12)
    shifted = filtered_deflection(_subhalos([0.15], [0.2]), GRID, GEOMETRY, 0.4)
    np.testing.assert_allclose(shifted[:, :, 1:], one[:, :, :-1], atol=1e-7)


def test_filter_sees_no_edge() -> None:
    """The crop of a wider field is the same: a subhalo outside the image acts as it should."""
    outside = _subhalos([1.9], [0.0])
    wide = filtered_deflection(outside, GRID.padded(30), GEOMETRY, 0.4)
    np.testing.assert_allclose(
        wide[:, 30:-30, 30:-30], filtered_deflection(outside, GRID, GEOMETRY, 0.4), atol=1e-12
    )
    assert np.abs(wide[:, 30:-30, 30:-30]).max() > 1e-5


def test_deflection_is_the_gradient_field_of_the_convergence() -> None:
    """div alpha = 2 kappa, before the filter as after it."""
    fine = PixelGrid.centred((160, 160), 0.0125)
    halo = _subhalos([0.003], [-0.002])
    kappa = convergence_map(halo, fine, GEOMETRY)
    alpha = filtered_deflection(halo, fine, GEOMETRY, 0.1)
    divergence = np.gradient(alpha[0], 0.0125, axis=1) + np.gradient(alpha[1], 0.0125, axis=0)
    expected = high_pass(2.0 * kappa, 0.1, 0.0125)
    ring = slice(40, 60)  # away from the cusp and from the edges
    np.testing.assert_allclose(
        divergence[ring, 40:120], expected[ring, 40:120], atol=0.01 * np.abs(expected).max()
    )


def test_required_half_width() -> None:
    assert required_half_width(GRID, 0.4) == pytest.approx(1.5 + 1.2)
    moved = PixelGrid.centred((60, 60), 0.05, x=-0.5)
    assert required_half_width(moved, 0.4) == pytest.approx(2.0 + 1.2)


KINDS = ("gaussian", "starlet", "median_wavelet")


def _mass_in_box(alpha: np.ndarray, half: int) -> float:
    """Mean of 2 kappa over the central box of 2 half + 1 pixels times its area: the flux through its edge."""
    ny, nx = alpha.shape[1:]
    rows, columns = slice(ny // 2 - half, ny // 2 + half + 1), slice(nx // 2 - half, nx // 2 + half + 1)
    divergence = np.gradient(alpha[0], 0.05, axis=1) + np.gradient(alpha[1], 0.05, axis=0)
    return float(divergence[rows, columns].sum() * 0.05**2)


@pytest.mark.parametrize("kind", KINDS)
def test_no_mass_is_left_beyond_the_filter(kind: FilterKind) -> None:
    """The mean convergence of a compact halo over a box of 8 filter widths; near, its mass is there."""
    grid = PixelGrid.centred((101, 101), 0.05)
    halo = dataclasses.replace(_subhalos([0.013], [-0.008]), r_s_kpc=np.array([0.3]), r_t_kpc=np.array([0.6]))
    scales = tnfw_angular_scales(
        halo.r_s_kpc, halo.r_t_kpc, halo.rho_s, GEOMETRY.kpc_per_arcsec, GEOMETRY.sigma_crit_msun_kpc2
    )
    on_sky = TnfwHalos(halo.x_arcsec, halo.y_arcsec, *scales)
    whole = _mass_in_box(tnfw_deflection(*grid.coordinates(), on_sky), 32)
    alpha = filtered_deflection(halo, grid, GEOMETRY, 0.4, kind)
    left = 0.08 if kind == "median_wavelet" else 0.005  # a median keeps no mass exactly
    assert abs(_mass_in_box(alpha, 32)) < left * whole
    assert _mass_in_box(alpha, 6) > 0.5 * whole


@pytest.mark.parametrize("kind", KINDS)
def test_mean_convergence_of_a_population_vanishes(kind: FilterKind) -> None:
    """In boxes of 3.25 arcsec, 8 filter widths, of a field full of subhalos."""
    rng = np.random.default_rng(3)
    subhalos = _subhalos(*rng.uniform(-6.0, 6.0, (2, 200)).tolist())
    grid = PixelGrid.centred((130, 130), 0.05)
    alpha = filtered_deflection(subhalos, grid, GEOMETRY, 0.4, kind)
    divergence = np.gradient(alpha[0], 0.05, axis=1) + np.gradient(alpha[1], 0.05, axis=0)
    patches = 0.5 * divergence.reshape(2, 65, 2, 65).mean(axis=(1, 3))
    kappa = convergence_map(subhalos, grid, GEOMETRY).reshape(2, 65, 2, 65).mean(axis=(1, 3))
    assert np.abs(patches).max() < 0.08 * kappa.min()
    assert np.abs(divergence).max() > 2.0 * kappa.mean()  # on small scales the mass is there


@pytest.mark.parametrize("kind", KINDS)
def test_no_filter_sees_an_edge(kind: FilterKind) -> None:
    outside = _subhalos([1.9], [0.0])
    wide = filtered_deflection(outside, GRID.padded(30), GEOMETRY, 0.4, kind)[:, 30:-30, 30:-30]
    np.testing.assert_allclose(wide, filtered_deflection(outside, GRID, GEOMETRY, 0.4, kind), atol=1e-12)
    assert np.abs(wide).max() > 1e-5


def test_filters_agree_on_what_is_small() -> None:
    """The paper's footnote: the details of the filter do not matter much."""
    rng = np.random.default_rng(4)
    subhalos = _subhalos(*rng.uniform(-1.5, 1.5, (2, 12)).tolist())
    gaussian, *others = (filtered_deflection(subhalos, GRID, GEOMETRY, 0.4, kind) for kind in KINDS)
    for other in others:
        assert np.corrcoef(other.ravel(), gaussian.ravel())[0, 1] > 0.9
        assert 0.7 < other.std() / gaussian.std() < 1.4


def test_smooth_host_holds_what_the_subhalos_do_not() -> None:
    cosmology = Cosmology()
    host = SmoothHost.of_halo(10**13.3, 4.0, 0.1, cosmology, 0.295)
    r_200 = float(cosmology.radius_200c(10**13.3, 0.295))
    assert host.r_s_kpc == pytest.approx(r_200 / 4.0)
    radius = np.linspace(0.0, r_200, 200_001)[1:]
    x = radius / host.r_s_kpc
    mass = np.trapezoid(4.0 * np.pi * radius**2 * host.rho_s / (x * (1.0 + x) ** 2), radius)
    assert mass == pytest.approx(0.9 * 10**13.3, rel=1e-4)
    for bad in ((0.0, 4.0, 0.1), (1e13, 0.0, 0.1), (1e13, 4.0, 1.0), (1e13, 4.0, -0.1), (1e13, 4.0, np.nan)):
        with pytest.raises(ValueError, match="smooth_host: false"):
            SmoothHost.of_halo(*bad, cosmology, 0.295)


def test_smooth_host_leaves_its_cusp() -> None:
    """lenstronomy's NFW through the same filter; it adds to the subhalos, and far out nothing is left."""
    host = SmoothHost.of_halo(10**13.3, 4.0, 0.1, Cosmology(), 0.295)
    subhalos = _subhalos([0.3], [0.2])
    grid = PixelGrid.centred((100, 100), 0.05)
    with_host = filtered_deflection(subhalos, grid, GEOMETRY, 0.4, host=host)
    added = with_host - filtered_deflection(subhalos, grid, GEOMETRY, 0.4)
    x, y = grid.padded(32).coordinates()
    r_s = host.r_s_kpc / GEOMETRY.kpc_per_arcsec
    scale = 4.0 * host.rho_s * host.r_s_kpc**2 / GEOMETRY.sigma_crit_msun_kpc2 / GEOMETRY.kpc_per_arcsec
    nfw = np.array(NFW().derivatives(x, y, Rs=r_s, alpha_Rs=scale * (1.0 - np.log(2.0))))
    expected = high_pass(nfw, 0.4, 0.05)[:, 32:-32, 32:-32]
    peak = np.abs(expected).max()
    np.testing.assert_allclose(added, expected, rtol=0, atol=2e-3 * peak)
    assert 1e-4 < peak < 0.1
    assert np.abs(added[:, :10]).max() < 0.35 * peak
