from __future__ import annotations

import numpy as np
import pytest

from warmlens.cosmology import Cosmology, LensGeometry
from warmlens.halos.population import Subhalos
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.high_pass import high_pass
from warmlens.lensing.substructure import convergence_map, filtered_deflection, required_half_width

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


def test_no_subhaloes_no_deflection() -> None:
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
