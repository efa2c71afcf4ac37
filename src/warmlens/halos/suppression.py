"""Published fits to the suppression of subhalo numbers in simulations of warm dark matter, for comparison only.

Each is the ratio of the differential mass functions, dN/dM warm over cold, as a function of the halo mass and of
the half-mode mass of the thermal relic. No realization uses them.
"""

from __future__ import annotations

from warmlens.types import FloatArray


def lovell14(mass_msun: FloatArray, half_mode_mass_msun: float) -> FloatArray:
    """Return the fit to subhalos of a Milky Way, (1 + 2.7 M_hm / M)^-0.99 (Lovell et al. 2014)."""
    return (1.0 + 2.7 * half_mode_mass_msun / mass_msun) ** -0.99


def lovell20(mass_msun: FloatArray, half_mode_mass_msun: float) -> FloatArray:
    """Return the fit to subhalos, [1 + (4.2 M_hm / M)^2.5]^-0.2 (Lovell 2020)."""
    return (1.0 + (4.2 * half_mode_mass_msun / mass_msun) ** 2.5) ** -0.2
