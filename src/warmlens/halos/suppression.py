"""How simulations suppress the number of (sub)halos of warm dark matter: published fits, for comparison only.

Each is the ratio of the differential mass functions, dN/dM warm over cold, as a function of the halo mass and of
the half-mode mass of the thermal relic. No realization uses them.
"""

from __future__ import annotations

from warmlens.types import FloatArray


def schneider12(mass_msun: FloatArray, half_mode_mass_msun: float) -> FloatArray:
    """Field halos: (1 + M_hm / M)^-0.6 (Schneider et al. 2012)."""
    return (1.0 + half_mode_mass_msun / mass_msun) ** -0.6


def lovell14(mass_msun: FloatArray, half_mode_mass_msun: float) -> FloatArray:
    """Subhalos of a Milky Way: (1 + 2.7 M_hm / M)^-0.99 (Lovell et al. 2014)."""
    return (1.0 + 2.7 * half_mode_mass_msun / mass_msun) ** -0.99


def lovell20(mass_msun: FloatArray, half_mode_mass_msun: float) -> FloatArray:
    """Subhalos: [1 + (4.2 M_hm / M)^2.5]^-0.2 (Lovell 2020)."""
    return (1.0 + (4.2 * half_mode_mass_msun / mass_msun) ** 2.5) ** -0.2
