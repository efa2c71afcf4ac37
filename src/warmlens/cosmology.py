"""Background cosmology and the geometry of the lens."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from warmlens.types import FloatArray

G_NEWTON = 4.30091727e-6  # kpc (km/s)^2 / Msun
SPEED_OF_LIGHT_KMS = 299792.458
DELTA_COLLAPSE = 1.686
KPC_PER_MPC = 1.0e3
ARCSEC_PER_RADIAN = 180.0 * 3600.0 / math.pi
HUBBLE_TIME_GYR_KMS_MPC = 977.792221  # 1 Mpc / (km/s) in Gyr

_CLOCK_Z_MAX = 1000.0
_CLOCK_POINTS = 8192


@dataclass(frozen=True)
class Cosmology:
    """Flat LCDM without radiation.

    Attributes
    ----------
    H0
        Hubble constant [km/s/Mpc].
    Om0, Ob0
        Present density of all matter and of baryons, in units of the critical density.
    sigma8
        Present linear rms of cold dark matter in top-hat spheres of 8 Mpc/h.
    ns
        Spectral index of the primordial power spectrum.
    Tcmb0
        Temperature of the microwave background [K]; enters the transfer function only.

    Notes
    -----
    The defaults are those of Birrer et al. 2017, section 1; they do not state Tcmb0.
    """

    H0: float = 69.31
    Om0: float = 0.315
    Ob0: float = 0.049
    sigma8: float = 0.829
    ns: float = 0.968
    Tcmb0: float = 2.7255

    def __post_init__(self) -> None:
        for name in ("H0", "Ob0", "sigma8", "ns", "Tcmb0"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name} must be finite and > 0, got {value!r}")
        if not self.Ob0 < self.Om0 < 1.0:
            raise ValueError(f"Om0 must lie between Ob0 = {self.Ob0!r} and 1, got {self.Om0!r}")

    @property
    def h(self) -> float:
        """H0 in units of 100 km/s/Mpc."""
        return self.H0 / 100.0

    @property
    def Ode0(self) -> float:  # noqa: N802
        """Present density of the cosmological constant, in units of the critical density."""
        return 1.0 - self.Om0

    @property
    def mean_density_msun_mpc3(self) -> float:
        """Comoving mean density of matter [Msun/Mpc^3]."""
        return self.Om0 * float(self.critical_density(0.0)) * KPC_PER_MPC**3

    def expansion(self, z: FloatArray | float) -> FloatArray:
        """Return H(z)/H0."""
        return np.sqrt(self.Om0 * _one_plus(z) ** 3 + self.Ode0)

    def matter_density(self, z: FloatArray | float) -> FloatArray:
        """Return the density of matter at z in units of the critical density at z."""
        return self.Om0 * _one_plus(z) ** 3 / self.expansion(z) ** 2

    def critical_density(self, z: FloatArray | float) -> FloatArray:
        """Return the critical density at z [Msun/kpc^3, physical]."""
        hubble = self.H0 / KPC_PER_MPC * self.expansion(z)  # km/s/kpc
        return 3.0 * hubble**2 / (8.0 * math.pi * G_NEWTON)

    def age(self, z: FloatArray | float) -> FloatArray:
        """Return the age of the universe at z [Gyr]."""
        dark_to_matter = math.sqrt(self.Ode0 / self.Om0)
        phase = np.arcsinh(dark_to_matter * _one_plus(z) ** -1.5)
        return HUBBLE_TIME_GYR_KMS_MPC / self.H0 * 2.0 / (3.0 * math.sqrt(self.Ode0)) * phase

    def growth(self, z: FloatArray | float) -> FloatArray:
        """Return the linear growth factor D(z), with D(0) = 1.

        It is the growth integral E(a) int a'^1.5 (Om + OL a'^3)^-1.5 da' in closed form.
        """
        from scipy.special import hyp2f1  # slow to import

        ratio = self.Ode0 / self.Om0
        a = 1.0 / _one_plus(z)
        unnormalised = a * hyp2f1(1.0 / 3.0, 1.0, 11.0 / 6.0, -ratio * a**3)
        return unnormalised / hyp2f1(1.0 / 3.0, 1.0, 11.0 / 6.0, -ratio)

    def virial_overdensity(self, z: FloatArray | float) -> FloatArray:
        """Return the virial density in units of the critical density (Bryan & Norman 1998, eq. 6)."""
        x = self.matter_density(z) - 1.0
        return 18.0 * math.pi**2 + 82.0 * x - 39.0 * x**2

    def radius_200c(self, mass_msun: FloatArray | float, z: FloatArray | float) -> FloatArray:
        """Return the physical radius [kpc] within which the mean density is 200 times critical."""
        return np.cbrt(3.0 * np.asarray(mass_msun) / (800.0 * math.pi * self.critical_density(z)))

    def collapse_clock(self, z: FloatArray | float) -> FloatArray:
        """Return the time variable of merger trees, w(z) = 1.686/D(z), which grows into the past."""
        return DELTA_COLLAPSE / self.growth(z)

    def clock_to_redshift(self, clock: FloatArray | float) -> FloatArray:
        """Return the redshift at which `collapse_clock` has the given value; the error of 1+z is < 1e-6."""
        clock = np.asarray(clock, dtype=np.float64)
        ln_clock, ln_one_plus_z = self._clock_table
        if np.any(~((np.log(clock) >= ln_clock[0]) & (np.log(clock) <= ln_clock[-1]))):
            raise ValueError(
                f"clock must lie between {math.exp(ln_clock[0])} (z = 0) and {math.exp(ln_clock[-1])} "
                f"(z = {_CLOCK_Z_MAX}), got values from {np.min(clock)} to {np.max(clock)}"
            )
        return np.expm1(np.interp(np.log(clock), ln_clock, ln_one_plus_z))

    @cached_property
    def _clock_table(self) -> tuple[FloatArray, FloatArray]:
        ln_one_plus_z = np.linspace(0.0, math.log1p(_CLOCK_Z_MAX), _CLOCK_POINTS)
        return np.log(self.collapse_clock(np.expm1(ln_one_plus_z))), ln_one_plus_z


def _one_plus(z: FloatArray | float) -> FloatArray:
    one_plus_z = 1.0 + np.asarray(z, dtype=np.float64)
    if not np.all(one_plus_z > 0.0):
        raise ValueError(f"z must be > -1, got {float(np.min(z))!r}")
    return one_plus_z


@dataclass(frozen=True)
class LensGeometry:
    """Redshifts and angular-diameter distances [Mpc] of lens and source."""

    z_lens: float
    z_source: float
    d_lens_mpc: float
    d_source_mpc: float
    d_lens_source_mpc: float

    @classmethod
    def from_redshifts(cls, cosmology: Cosmology, z_lens: float, z_source: float) -> LensGeometry:
        """Compute the distances of a lens and a source in the given cosmology."""
        if not 0.0 < z_lens < z_source < math.inf:
            raise ValueError(f"0 < z_lens < z_source is needed, got z_lens={z_lens!r}, z_source={z_source!r}")
        from astropy.cosmology import FlatLambdaCDM  # 0.5 s to import

        background = FlatLambdaCDM(H0=cosmology.H0, Om0=cosmology.Om0, Tcmb0=0.0)
        to_lens = float(background.comoving_distance(z_lens).value)
        to_source = float(background.comoving_distance(z_source).value)
        return cls(
            z_lens=z_lens,
            z_source=z_source,
            d_lens_mpc=to_lens / (1.0 + z_lens),
            d_source_mpc=to_source / (1.0 + z_source),
            d_lens_source_mpc=(to_source - to_lens) / (1.0 + z_source),  # space is flat
        )

    @property
    def kpc_per_arcsec(self) -> float:
        """Physical length at the lens that one arcsec spans [kpc]."""
        return self.d_lens_mpc * KPC_PER_MPC / ARCSEC_PER_RADIAN

    @property
    def sigma_crit_msun_kpc2(self) -> float:
        """Critical surface density c^2 D_s / (4 pi G D_l D_ls) [Msun/kpc^2]."""
        distance_kpc = KPC_PER_MPC * self.d_lens_mpc * self.d_lens_source_mpc / self.d_source_mpc
        return SPEED_OF_LIGHT_KMS**2 / (4.0 * math.pi * G_NEWTON * distance_kpc)

    @property
    def sigma_crit_msun_arcsec2(self) -> float:
        """Critical surface density [Msun/arcsec^2]."""
        return self.sigma_crit_msun_kpc2 * self.kpc_per_arcsec**2
