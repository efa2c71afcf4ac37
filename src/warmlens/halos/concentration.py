"""Concentrations of cold dark matter halos, and their mapping to warm dark matter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warmlens.halos.power_spectrum import SharpKVariance
from warmlens.types import FloatArray

COLLAPSED_FRACTION = 0.05
_MAP_MIN_MSUN = 1.0e3
_MAP_POINTS = 4096


@dataclass(frozen=True)
class ConcentrationRelation:
    """Power law c = amplitude (M/pivot)^mass_slope (1+z)^redshift_slope of cold dark matter (200c).

    The coefficients are A_c, B_c and C_c of Birrer et al. 2017, section 3.1.3; smaller concentrations are raised
    to `minimum`.
    """

    amplitude: float = 5.22
    mass_slope: float = -0.072
    redshift_slope: float = -0.42
    pivot_msun: float = 2.0e12
    minimum: float = 1.5

    @classmethod
    def duffy08(cls, h: float, minimum: float) -> ConcentrationRelation:
        """Return the relation of Duffy et al. 2008, table 1 (all halos, NFW, M200), for 0 < z < 2 and this h."""
        return cls(5.71, -0.084, -0.47, 2.0e12 / h, minimum)

    def __call__(self, mass_msun: FloatArray | float, z: FloatArray | float) -> FloatArray:
        """Return the concentration of cold halos of mass M200c [Msun] at redshift z; shapes broadcast."""
        mass_term = (np.asarray(mass_msun) / self.pivot_msun) ** self.mass_slope
        redshift_term = (1.0 + np.asarray(z)) ** self.redshift_slope
        return np.maximum(self.amplitude * mass_term * redshift_term, self.minimum)


def scatter_concentration(
    median: FloatArray, scatter_dex: float, minimum: float, rng: np.random.Generator
) -> FloatArray:
    """Draw concentrations with log-normal scatter [dex] about the median, raised to the minimum.

    Without scatter no random number is drawn.
    """
    if scatter_dex == 0.0:
        return median
    return np.maximum(median * 10.0 ** (scatter_dex * rng.standard_normal(median.shape)), minimum)


@dataclass(frozen=True)
class FormationHistory:
    """Cold halos by the variance that they gain between 5% of their mass and the whole.

    Two halos of any dark matter collapse at the same time if they gain the same variance:
    w(z_c) = w(z) + sqrt(pi/2 [S(fM) - S(M)]), so that pi/2, z and any factor of the barrier cancel.
    """

    ln_gain: FloatArray  # ln[S(fM) - S(M)], ascending
    ln_mass: FloatArray  # ln(M/Msun) of the cold halo, descending

    @classmethod
    def of_cold_halos(cls, cold: SharpKVariance, mass_cap_msun: float) -> FormationHistory:
        """Tabulate cold halos up to the mass cap [Msun], which is the longest delay that is mapped."""
        mass = np.geomspace(mass_cap_msun, _MAP_MIN_MSUN, _MAP_POINTS)
        return cls(np.log(variance_gain(cold, mass)), np.log(mass))

    def matching_mass(self, variance: SharpKVariance, mass_msun: FloatArray) -> FloatArray:
        """Return the mass [Msun] of the cold halo that forms when a halo of mass M [Msun] of `variance` does.

        Reference: Schneider 2015 (Birrer et al. 2017, section 3.1.3).
        """
        floor = np.exp(self.ln_gain[0])
        gain = np.maximum(variance_gain(variance, mass_msun), floor)
        return np.exp(np.interp(np.log(gain), self.ln_gain, self.ln_mass))


def variance_gain(variance: SharpKVariance, mass_msun: FloatArray) -> FloatArray:
    """Return S(fM) - S(M) with f = 0.05 for halos of mass M [Msun]."""
    return variance.variance(COLLAPSED_FRACTION * mass_msun) - variance.variance(mass_msun)
