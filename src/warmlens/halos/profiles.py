"""Density profiles of subhalos: from the infall structure to a truncated NFW profile."""

from __future__ import annotations

import math

import numpy as np

from warmlens.cosmology import G_NEWTON, Cosmology
from warmlens.types import FloatArray

X_MAX = 2.16258159  # r_max / r_s of an NFW profile
G_MAX = 0.46758603  # nfw_mass(X_MAX)
V_MAX_FACTOR = G_MAX / X_MAX  # v_max^2 = V_MAX_FACTOR 4 pi G rho_s r_s^2

_TAU_MIN, _TAU_MAX, _TAU_POINTS = 1.0e-3, 1.0e4, 8192
_X_FLOOR = 1.0e-4  # the projected mass cancels to rounding errors below


def nfw_mass(x: FloatArray | float) -> FloatArray:
    """Mass of an NFW profile within x = r/r_s, in units of 4 pi rho_s r_s^3."""
    return np.log1p(x) - np.asarray(x) / (1.0 + np.asarray(x))


def infall_structure(
    m_acc_msun: FloatArray, z_acc: FloatArray, concentration: FloatArray, cosmology: Cosmology
) -> tuple[FloatArray, FloatArray]:
    """Radius r_max [kpc] and value v_max [km/s] of the circular-velocity peak at infall.

    Parameters
    ----------
    m_acc_msun
        M200c at infall [Msun].
    z_acc
        Redshift of infall.
    concentration
        R200c/r_s at infall.
    cosmology
        Background.
    """
    r_200 = cosmology.radius_200c(m_acc_msun, z_acc)
    v_200_squared = G_NEWTON * m_acc_msun / r_200
    r_max = X_MAX * r_200 / concentration
    v_max = np.sqrt(V_MAX_FACTOR * concentration / nfw_mass(concentration) * v_200_squared)
    return r_max, v_max


def tidal_tracks(bound_fraction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ratios of r_max and of v_max to their values at infall, for x = m/m_acc.

    Reference: Penarrubia et al. 2010, inner slope 1: y = 2^alpha x^beta / (1+x)^alpha.
    """
    half = 0.5 * (1.0 + bound_fraction)
    return half**0.3 * bound_fraction**0.4, half**-0.4 * bound_fraction**0.3


def nfw_parameters(r_max_kpc: FloatArray, v_max_kms: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Scale radius [kpc] and scale density [Msun/kpc^3] of the NFW profile with that velocity peak."""
    r_s = r_max_kpc / X_MAX
    return r_s, v_max_kms**2 / (4.0 * math.pi * G_NEWTON * r_s**2 * V_MAX_FACTOR)


def nfw_norm(r_s_kpc: FloatArray, rho_s: FloatArray) -> FloatArray:
    """Mass unit 4 pi rho_s r_s^3 [Msun] for rho_s [Msun/kpc^3]."""
    return 4.0 * math.pi * rho_s * r_s_kpc**3


def tnfw_total_mass(tau: FloatArray) -> FloatArray:
    """Total mass of the truncated profile rho_NFW tau^2/(tau^2 + x^2), in units of 4 pi rho_s r_s^3.

    Reference: Baltz, Marshall & Oguri 2009, appendix A (n = 1).
    """
    t2 = tau**2
    return t2 / (t2 + 1.0) ** 2 * ((t2 - 1.0) * np.log(tau) + math.pi * tau - (t2 + 1.0))


def truncation(mass_ratio: FloatArray) -> FloatArray:
    """Truncation tau = r_t/r_s for which the total mass is mass_ratio times 4 pi rho_s r_s^3.

    The inverse of `tnfw_total_mass`, which rises from 0 without bound; the relative error is < 1e-6.
    """
    ln_tau = np.linspace(math.log(_TAU_MIN), math.log(_TAU_MAX), _TAU_POINTS)
    ln_mass = np.log(tnfw_total_mass(np.exp(ln_tau)))
    ln_ratio = np.log(mass_ratio)
    if np.any(~((ln_ratio >= ln_mass[0]) & (ln_ratio <= ln_mass[-1]))):
        raise ValueError(
            f"mass_ratio must lie between {math.exp(ln_mass[0]):.3g} and {math.exp(ln_mass[-1]):.3g}, "
            f"got values from {np.min(mass_ratio)!r} to {np.max(mass_ratio)!r}"
        )
    return np.exp(np.interp(ln_ratio, ln_mass, ln_tau))


def tnfw_mass(x: FloatArray, tau: FloatArray | float) -> FloatArray:
    """Mass of the truncated profile within the sphere x = r/r_s, in units of 4 pi rho_s r_s^3.

    Reference: Baltz, Marshall & Oguri 2009, appendix A (n = 1).
    """
    x, tau = np.asarray(x, dtype=np.float64), np.asarray(tau, dtype=np.float64)
    t2 = tau**2
    inner = -(t2 + 1.0) * x / (1.0 + x) + 2.0 * tau * np.arctan(x / tau)
    outer = (t2 - 1.0) * np.log((1.0 + x) * tau / np.sqrt(x**2 + t2))
    return t2 / (t2 + 1.0) ** 2 * (inner + outer)


def tnfw_projected_mass(x: FloatArray, tau: FloatArray | float) -> FloatArray:
    """Mass of the truncated profile within the cylinder x = R/r_s, in units of 4 pi rho_s r_s^3.

    Below x = 1e-4, where the terms cancel, the mass at 1e-4 is returned.
    Reference: Baltz, Marshall & Oguri 2009, appendix A (n = 1).
    """
    x = np.maximum(np.asarray(x, dtype=np.float64), _X_FLOOR)
    tau = np.asarray(tau, dtype=np.float64)
    t2 = tau**2
    root = np.sqrt(t2 + x**2)
    ell = np.log(x / (root + tau))
    outer = root * (-math.pi + (t2 - 1.0) / tau * ell)
    inner = (t2 + 1.0 + 2.0 * (x**2 - 1.0)) * _nfw_kernel(x) + math.pi * tau + (t2 - 1.0) * np.log(tau)
    return t2 / (t2 + 1.0) ** 2 * (inner + outer)


def _nfw_kernel(x: FloatArray) -> FloatArray:
    """acosh(1/x)/sqrt(1-x^2), continued through x = 1; half-angle forms keep all digits near 1."""
    gap = np.abs(1.0 - x)
    root = np.sqrt(gap * (1.0 + x))
    ratio = np.sqrt(gap / (1.0 + x))
    angle = np.where(x < 1.0, np.arctanh(np.where(x < 1.0, ratio, 0.0)), np.arctan(ratio))
    return np.where(root > 0.0, 2.0 * angle / np.where(root > 0.0, root, 1.0), 1.0)
