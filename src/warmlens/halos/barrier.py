"""Collapse threshold of warm dark matter halos in units of that of cold ones.

The constant factor 1.197 of the sharp-k filter is applied in `merger_tree.branching_table`.
"""

from __future__ import annotations

import numpy as np

from warmlens.cosmology import Cosmology
from warmlens.types import FloatArray

# Below this ln(M/M_J) the weight of the high-mass branch is < 1e-11, but its double exponential diverges.
_HIGH_BRANCH_FLOOR = -5.0
_X_FLOOR = -10.0


def jeans_mass(m_th_kev: float, cosmology: Cosmology) -> float:
    """Return the effective Jeans mass of a spin-1/2 thermal relic at equality [Msun]; 0 for cold dark matter.

    Birrer et al. 2017 call it the characteristic mass, and make it the resolution of the merger tree.

    Reference: Barkana et al. 2001, eq. 10.
    """
    omega_h2 = cosmology.Om0 * cosmology.h**2
    one_plus_z_eq = 3600.0 * omega_h2 / 0.15
    return 3.06e8 * (one_plus_z_eq / 3000.0) ** 1.5 * (omega_h2 / 0.15) ** 0.5 * m_th_kev**-4.0


def barrier_ratio(mass_msun: FloatArray, jeans_mass_msun: float) -> FloatArray:
    """Return the threshold of collapse in units of that of cold dark matter at the same time, any shape.

    The ratio is 1 for a Jeans mass of 0, which stands for cold dark matter. Reference: Benson et al. 2013,
    eqs. 7-10, a fit to Barkana et al. 2001 (Birrer et al. 2017 cite the equation numbers under Barkana et al.).
    """
    if not jeans_mass_msun >= 0.0:
        raise ValueError(f"jeans_mass_msun must be >= 0, got {jeans_mass_msun!r}")
    mass = np.asarray(mass_msun, dtype=np.float64)
    if jeans_mass_msun == 0.0:
        return np.ones_like(mass)
    x = np.maximum(np.log(mass / jeans_mass_msun), _X_FLOOR)  # eq. 8
    step = np.tanh((x + 2.4) / 0.2)
    weight = 0.5 * (1.0 - step)  # eq. 10: 1 / (1 + exp((x + 2.4) / 0.1)), free of overflow
    low_mass = 0.04 * np.exp(-2.3 * x)  # eq. 7, first term
    high_mass = np.exp(0.31687 * np.exp(-0.809 * np.maximum(x, _HIGH_BRANCH_FLOOR)))  # eq. 7, second term
    return weight * low_mass + (1.0 - weight) * high_mass
