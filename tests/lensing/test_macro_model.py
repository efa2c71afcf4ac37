from __future__ import annotations

import numpy as np
import pytest
from scipy.special import hyp2f1

from warmlens.lensing.macro_model import deflection, lens_light

X, Y = np.meshgrid(np.linspace(-2.5, 2.4, 9), np.linspace(-2.4, 2.5, 8))


def test_isothermal_sphere() -> None:
    alpha = deflection(["SIS"], [{"theta_E": 0.213, "center_x": -0.097, "center_y": 0.614}], X, Y)
    dx, dy = X + 0.097, Y - 0.614
    np.testing.assert_allclose(alpha, 0.213 * np.array([dx, dy]) / np.hypot(dx, dy), atol=1e-6)


def test_elliptical_power_law_of_tessore_and_metcalf() -> None:
    """Tessore & Metcalf 2015, eq. 13, with scipy's hypergeometric function."""
    theta_e, gamma, e1, e2 = 1.634, 1.957, 0.0831, 0.1065
    e, phi = np.hypot(e1, e2), 0.5 * np.arctan2(e2, e1)
    q, t = (1 - e) / (1 + e), gamma - 1
    z = (X + 1j * Y) * np.exp(-1j * phi)
    radius, angle = np.hypot(q * z.real, z.imag), np.arctan2(z.imag, q * z.real)
    b, f = theta_e * np.sqrt(q), (1 - q) / (1 + q)
    turn = np.exp(1j * angle)
    omega = turn * hyp2f1(1.0, 0.5 * t, 2.0 - 0.5 * t, -f * turn**2)
    alpha = 2 * b / (1 + q) * (b / radius) ** (t - 1) * omega * np.exp(1j * phi)
    kwargs = {"theta_E": theta_e, "gamma": gamma, "e1": e1, "e2": e2, "center_x": 0.0, "center_y": 0.0}
    np.testing.assert_allclose(deflection(["EPL"], [kwargs], X, Y), [alpha.real, alpha.imag], atol=1e-8)


def test_quasar_images_share_a_source(paper_lens: tuple[list[str], list[dict[str, object]]]) -> None:
    """The default lens sends the published images to one point within 15 mas (RXJ1131-1231)."""
    images = np.array([[-2.037, -0.520], [-2.076, 0.662], [-1.460, -1.632], [1.074, 0.356]])
    beta = images.T - deflection(*paper_lens, images[:, 0], images[:, 1])
    assert np.abs(beta - np.array([[-0.503], [-0.058]])).max() < 0.015


def test_lens_light_is_linear_in_its_amplitude() -> None:
    light = lens_light(
        ["SERSIC", "SERSIC"],
        [
            {"R_sersic": 0.3, "n_sersic": 1.6, "center_x": 0.0, "center_y": 0.0},
            {"R_sersic": 1.0, "n_sersic": 1.0, "center_x": 0.1, "center_y": 0.0},
        ],
        np.array([0.3, 0.1]),
        np.array([0.0, 1.0]),
    )
    assert light.shape == (2, 2)
    assert light[0, 0] == pytest.approx(1.0)  # the amplitude is the brightness at R_sersic
    assert light[1, 1] == pytest.approx(1.0)


def test_errors() -> None:
    with pytest.raises(ValueError, match=r"smooth_model\.lens"):
        deflection(["EPLL"], [{}], X, Y)
    with pytest.raises(ValueError, match=r"smooth_model\.lens"):
        deflection(["SIS"], [{"theta_e": 1.0}], X, Y)
    with pytest.raises(ValueError, match=r"smooth_model\.lens_light"):
        lens_light(["SERSIC"], [{"radius": 1.0}], X, Y)
