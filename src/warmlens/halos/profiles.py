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


def nfw_mass(x: FloatArray | float) -> FloatArray:
    """Return the mass of an NFW profile within x = r/r_s, in units of 4 pi rho_s r_s^3."""
    return np.log1p(x) - np.asarray(x) / (1.0 + np.asarray(x))


def infall_structure(
    m_acc_msun: FloatArray, z_acc: FloatArray, concentration: FloatArray, cosmology: Cosmology
) -> tuple[FloatArray, FloatArray]:
    """Return the radius r_max [kpc] and the value v_max [km/s] of the circular-velocity peak at infall.

    The mass is M200c [Msun] and the concentration R200c/r_s, both at infall.
    """
    r_200 = cosmology.radius_200c(m_acc_msun, z_acc)
    v_200_squared = G_NEWTON * m_acc_msun / r_200
    r_max = X_MAX * r_200 / concentration
    v_max = np.sqrt(V_MAX_FACTOR * concentration / nfw_mass(concentration) * v_200_squared)
    return r_max, v_max


def tidal_tracks(bound_fraction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the ratios of r_max and of v_max to their values at infall, for x = m/m_acc.

    Reference: Penarrubia et al. 2010, inner slope 1: y = 2^alpha x^beta / (1+x)^alpha.
    """
    half = 0.5 * (1.0 + bound_fraction)
    return half**0.3 * bound_fraction**0.4, half**-0.4 * bound_fraction**0.3


def nfw_parameters(r_max_kpc: FloatArray, v_max_kms: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the scale radius [kpc] and scale density [Msun/kpc^3] of the NFW profile with that velocity peak."""
    r_s = r_max_kpc / X_MAX
    return r_s, v_max_kms**2 / (4.0 * math.pi * G_NEWTON * r_s**2 * V_MAX_FACTOR)


def nfw_norm(r_s_kpc: FloatArray, rho_s: FloatArray) -> FloatArray:
    """Return the mass unit 4 pi rho_s r_s^3 [Msun] for rho_s [Msun/kpc^3]."""
    return 4.0 * math.pi * rho_s * r_s_kpc**3


def tnfw_total_mass(tau: FloatArray) -> FloatArray:
    """Return the total mass of the truncated profile rho_NFW tau^2/(tau^2 + x^2), in units of 4 pi rho_s r_s^3.

    Reference: Baltz, Marshall & Oguri 2009, appendix A (n = 1).
    """
    t2 = tau**2
    return t2 / (t2 + 1.0) ** 2 * ((t2 - 1.0) * np.log(tau) + math.pi * tau - (t2 + 1.0))


def truncation(mass_ratio: FloatArray) -> FloatArray:
    """Return the truncation tau = r_t/r_s for which the total mass is mass_ratio times 4 pi rho_s r_s^3.

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
