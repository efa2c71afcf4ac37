"""How subhalos lose mass: tidal stripping and dynamical friction."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from warmlens.cosmology import Cosmology
from warmlens.types import FloatArray

DynamicalTime = Literal["paper", "jvdb16"]

DYNAMICAL_TIMES_PER_EFOLD = 10.0  # ln(a) per tau_dyn = 0.1/H
CIRCULARITY_INDEX = 1.22  # Zentner et al. 2005: P(eta) ~ [eta (1 - eta)]^1.22
_INTEGRAL_POINTS = 512


def loss_per_efold(z: FloatArray, amplitude: float, tau_dyn: DynamicalTime, cosmology: Cosmology) -> FloatArray:
    """Return the loss coefficient K = A / (tau_dyn H) per e-fold of expansion, any shape.

    The amplitude is A_ts of dm/dt = -A_ts (m/tau_dyn) (m/M)^zeta. The dynamical time is 0.1/H for "paper"
    (Birrer et al. 2017) and (pi/sqrt 2) Delta_vir^(-1/2)/H for "jvdb16", for which A_ts was calibrated (Jiang &
    van den Bosch 2016, eq. 2).
    """
    if tau_dyn == "paper":
        return np.full(np.shape(z), amplitude * DYNAMICAL_TIMES_PER_EFOLD)
    if tau_dyn == "jvdb16":
        return amplitude * np.sqrt(2.0 * cosmology.virial_overdensity(z)) / math.pi
    raise ValueError(f'tau_dyn must be "paper" or "jvdb16", got {tau_dyn!r}')


@dataclass(frozen=True)
class TidalField:
    """Running integral of K M^-zeta over ln a in a host that grows."""

    ln_a: FloatArray  # ascending
    integral: FloatArray  # from the first to each ln a [Msun^-zeta]
    slope: float  # zeta of the loss rate

    @classmethod
    def of_host(
        cls,
        ln_a: FloatArray,
        ln_host_mass: FloatArray,
        amplitude: float,
        slope: float,
        tau_dyn: DynamicalTime,
        cosmology: Cosmology,
    ) -> TidalField:
        """Integrate along a host's history ln M(ln a), both ascending in ln a and linear in between."""
        if not slope > 0.0:
            raise ValueError(f"stripping_slope must be > 0, got {slope!r}")
        grid = np.linspace(ln_a[0], ln_a[-1], _INTEGRAL_POINTS)
        rate = loss_per_efold(np.expm1(-grid), amplitude, tau_dyn, cosmology)
        rate = rate * np.exp(-slope * np.interp(grid, ln_a, ln_host_mass))
        steps = 0.5 * np.diff(grid) * (rate[1:] + rate[:-1])
        return cls(grid, np.concatenate(([0.0], np.cumsum(steps))), slope)

    def bound_mass(self, m_acc_msun: FloatArray, ln_a_acc: FloatArray) -> FloatArray:
        """Return the mass left at the last ln a of subhalos accreted with mass m_acc [Msun] at ln_a_acc.

        Exact for any growth of the host, since d(m^-zeta)/dlna = zeta K M^-zeta. Reference: the rate is
        that of van den Bosch et al. 2005 and Giocoli et al. 2008 (Birrer et al. 2017, section 3.1.4).
        """
        exposure = self.integral[-1] - np.interp(ln_a_acc, self.ln_a, self.integral)
        growth = self.slope * m_acc_msun**self.slope * exposure
        return m_acc_msun * (1.0 + growth) ** (-1.0 / self.slope)


def draw_circularity(count: int, rng: np.random.Generator) -> FloatArray:
    """Draw the circularities of orbits at infall, in (0, 1) (Zentner et al. 2005)."""
    return rng.beta(CIRCULARITY_INDEX + 1.0, CIRCULARITY_INDEX + 1.0, size=count)


def friction_ln_a(
    ln_a_acc: FloatArray,
    mass_ratio: FloatArray,
    circularity: FloatArray,
    amplitude: float,
    mass_slope: float,
    circularity_slope: float,
) -> FloatArray:
    """Return ln a at which dynamical friction has dragged a subhalo to the centre.

    The mass ratio is that of host over subhalo, and the circularity that of the orbit, both at infall; amplitude
    and slopes are A_df, b_df and c_df. Reference: Boylan-Kolchin et al. 2008, eq. 6, without orbital energy, and
    a_df = a_acc exp(n_dyn/10) of Birrer et al. 2017, both with tau_dyn = 0.1/H.
    """
    n_dyn = amplitude * mass_ratio**mass_slope / np.log1p(mass_ratio)  # Boylan-Kolchin et al. eq. 6
    n_dyn = n_dyn * np.exp(circularity_slope * circularity)
    return ln_a_acc + n_dyn / DYNAMICAL_TIMES_PER_EFOLD
