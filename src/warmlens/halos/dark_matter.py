"""Models of dark matter: their free-streaming break and their threshold of collapse."""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from warmlens.cosmology import Cosmology
from warmlens.halos.barrier import barrier_ratio, jeans_mass
from warmlens.types import FloatArray

TransferFunction = Literal["viel05", "bode01", "vogel23"]

LIGHTEST_RELIC_KEV = 1.0e-3  # its Jeans mass of 4e20 Msun leaves no halo

# Index nu of each form [1 + (alpha k)^(2 nu)]^(-5/nu).
TRANSFER_INDEX: dict[TransferFunction, float] = {"viel05": 1.12, "bode01": 1.2, "vogel23": 1.049}


class DarkMatter(Hashable, Protocol):
    """What the halos need of a model of dark matter.

    Equal models must compare equal and have the same hash, as frozen dataclasses do: tables are cached by model.
    """

    @property
    def label(self) -> str:
        """Short name for messages and legends."""

    @property
    def resolution_msun(self) -> float:
        """Smallest mass that merger trees need to follow [Msun]; 0 if halos have every mass."""

    def transfer(self, k_hmpc: FloatArray) -> FloatArray:
        """Return the amplitude ratio sqrt(P / P_cold) at wave numbers [h/Mpc], any shape."""

    def barrier_ratio(self, mass_msun: FloatArray) -> FloatArray:
        """Return the threshold of collapse at mass [Msun], any shape, in units of that of cold dark matter."""


@dataclass(frozen=True)
class ColdDarkMatter:
    """Dark matter without free streaming."""

    @property
    def label(self) -> str:
        """Short name for messages and legends."""
        return "cold dark matter"

    @property
    def resolution_msun(self) -> float:
        """0: halos have every mass."""
        return 0.0

    def transfer(self, k_hmpc: FloatArray) -> FloatArray:
        """Return 1 at every wave number [h/Mpc]."""
        return np.ones_like(k_hmpc, dtype=np.float64)

    def barrier_ratio(self, mass_msun: FloatArray) -> FloatArray:
        """Return 1 at every mass [Msun]."""
        return np.ones_like(mass_msun, dtype=np.float64)


@dataclass(frozen=True)
class ThermalRelic:
    """Warm dark matter: a spin-1/2 fermion that decoupled in equilibrium while relativistic.

    Attributes
    ----------
    m_th_kev
        Mass of the particle [keV], finite and at least `LIGHTEST_RELIC_KEV`.
    cosmology
        Background; all of the dark matter is warm.
    transfer_function
        Fit to the free-streaming break: "viel05" (Viel et al. 2005, eqs. 6-7), "bode01" (Bode et al. 2001,
        eq. A9) or "vogel23" (Vogel & Abazajian 2023).
    """

    m_th_kev: float
    cosmology: Cosmology
    transfer_function: TransferFunction = "viel05"

    def __post_init__(self) -> None:
        if not LIGHTEST_RELIC_KEV <= self.m_th_kev < math.inf:
            raise ValueError(f"m_th_kev must be finite and >= {LIGHTEST_RELIC_KEV:g} keV, got {self.m_th_kev!r}")
        if self.transfer_function not in TRANSFER_INDEX:
            names = ", ".join(f'"{name}"' for name in TRANSFER_INDEX)
            raise ValueError(f"transfer_function must be one of {names}, got {self.transfer_function!r}")

    @property
    def label(self) -> str:
        """Short name for messages and legends."""
        return f"thermal relic of {self.m_th_kev:g} keV"

    @property
    def resolution_msun(self) -> float:
        """Effective Jeans mass at equality [Msun], the characteristic mass of Birrer et al. 2017."""
        return jeans_mass(self.m_th_kev, self.cosmology)

    @property
    def alpha_mpch(self) -> float:
        """Scale of the free-streaming break [Mpc/h]; the density in it is that of the dark matter alone."""
        h, omega_x = self.cosmology.h, self.cosmology.Om0 - self.cosmology.Ob0
        if self.transfer_function == "viel05":  # Viel et al. 2005, eq. 7
            return 0.049 * self.m_th_kev**-1.11 * (omega_x / 0.25) ** 0.11 * (h / 0.7) ** 1.22
        if self.transfer_function == "bode01":  # Bode et al. 2001, eq. A9, g_X = 1.5
            return 0.048 * self.m_th_kev**-1.15 * (omega_x / 0.4) ** 0.15 * (h / 0.65) ** 1.3
        assert self.transfer_function == "vogel23"  # Vogel & Abazajian 2023, spin 1/2
        omega_h2 = omega_x * h**2
        return 0.0437 * self.m_th_kev**-1.188 * (omega_h2 / 0.12) ** 0.2463 * (h / 0.6736) ** 2.012

    def transfer(self, k_hmpc: FloatArray) -> FloatArray:
        """Return the amplitude ratio sqrt(P / P_cold) at wave numbers [h/Mpc], any shape.

        Reference: Bode et al. 2001, eq. A8; Viel et al. 2005, eq. 6.
        """
        nu = TRANSFER_INDEX[self.transfer_function]
        return (1.0 + (self.alpha_mpch * k_hmpc) ** (2.0 * nu)) ** (-5.0 / nu)  # Viel et al. 2005, eq. 6

    def barrier_ratio(self, mass_msun: FloatArray) -> FloatArray:
        """Return the threshold of collapse in units of that of cold dark matter, see `warmlens.halos.barrier`."""
        return barrier_ratio(mass_msun, self.resolution_msun)

    @property
    def half_mode_wavelength_mpch(self) -> float:
        """Wavelength [Mpc/h] at which the amplitude ratio is 1/2."""
        nu = TRANSFER_INDEX[self.transfer_function]
        return 2.0 * math.pi * self.alpha_mpch * (2.0 ** (nu / 5.0) - 1.0) ** (-1.0 / (2.0 * nu))

    @property
    def half_mode_mass_msun(self) -> float:
        """Mean mass in a sphere whose diameter is the half-mode wavelength [Msun]."""
        radius_mpc = 0.5 * self.half_mode_wavelength_mpch / self.cosmology.h
        return 4.0 * math.pi / 3.0 * self.cosmology.mean_density_msun_mpc3 * radius_mpc**3


def dark_matter(
    m_th_kev: float, cosmology: Cosmology, transfer_function: TransferFunction = "viel05"
) -> DarkMatter:
    """Return the thermal relic of mass m_th_kev [keV], or cold dark matter if the mass is inf."""
    if m_th_kev == math.inf:
        return ColdDarkMatter()
    if not m_th_kev > 0.0:
        raise ValueError(f"m_th_kev must be > 0 (inf for cold dark matter), got {m_th_kev!r}")
    return ThermalRelic(m_th_kev, cosmology, transfer_function)
