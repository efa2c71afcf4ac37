"""Linear power spectrum of cold dark matter, and the variance of the density field."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from warmlens.cosmology import Cosmology
from warmlens.types import FloatArray

_K_MIN_HMPC = 1.0e-5
_K_MAX_HMPC = 1.0e4
_K_POINTS = 8192


@dataclass(frozen=True)
class LinearPower:
    """Power spectrum of cold dark matter at z = 0: P(k) [(Mpc/h)^3] at k [h/Mpc], equally spaced in ln k."""

    k_hmpc: FloatArray
    power: FloatArray

    @property
    def step(self) -> float:
        """Spacing of the grid in ln k."""
        return math.log(self.k_hmpc[-1] / self.k_hmpc[0]) / (self.k_hmpc.size - 1)

    @property
    def dimensionless(self) -> FloatArray:
        """Variance per unit of ln k, Delta^2 = k^3 P / (2 pi^2)."""
        return self.k_hmpc**3 * self.power / (2.0 * math.pi**2)


def cdm_power(cosmology: Cosmology) -> LinearPower:
    """Return the cold power spectrum, normalised to sigma8 in top-hat spheres of 8 Mpc/h.

    Reference: Eisenstein & Hu 1998, eqs. 26 and 28-31 (without acoustic wiggles), as coded in colossus.
    """
    from colossus.cosmology.power_spectrum import modelEisenstein98ZeroBaryon  # slow to import

    k = np.geomspace(_K_MIN_HMPC, _K_MAX_HMPC, _K_POINTS)
    transfer = modelEisenstein98ZeroBaryon(k, cosmology.h, cosmology.Om0, cosmology.Ob0, cosmology.Tcmb0)
    raw = LinearPower(k, k**cosmology.ns * transfer**2)
    raw_sigma8 = float(top_hat_sigma(raw, np.array([8.0]))[0])
    return LinearPower(k, raw.power * (cosmology.sigma8 / raw_sigma8) ** 2)


@dataclass(frozen=True)
class SharpKVariance:
    """Variance S(M) of the linear density field at z = 0, sharp-k filtered, as a table in ln(M/Msun)."""

    ln_mass: FloatArray  # ascending and equally spaced
    ln_variance: FloatArray
    slope: FloatArray  # -dln(sigma)/dlnM

    def variance(self, mass_msun: FloatArray) -> FloatArray:
        """Return S(M) = sigma^2(M), any shape."""
        return np.exp(np.interp(np.log(mass_msun), self.ln_mass, self.ln_variance))

    def log_slope(self, mass_msun: FloatArray) -> FloatArray:
        """Return the logarithmic slope alpha(M) = -dln(sigma)/dlnM, any shape."""
        return np.interp(np.log(mass_msun), self.ln_mass, self.slope)


def filtered_variance(
    transfer: Callable[[FloatArray], FloatArray], spectrum: LinearPower, cosmology: Cosmology, sharp_k_a: float
) -> SharpKVariance:
    """Tabulate the variance with a filter that is 1 below k_s = a/R(M) and 0 above.

    Parameters
    ----------
    transfer
        Amplitude ratio to cold dark matter as a function of k [h/Mpc].
    spectrum
        Cold power spectrum; its normalisation is kept for every dark matter.
    sharp_k_a
        Ratio a between k_s and 1/R.

    Notes
    -----
    The masses are those of the wave numbers of `spectrum`, so the table is the running integral itself; its
    spacing leaves errors below 1e-5. Reference: Benson et al. 2013.
    """
    ratio = transfer(spectrum.k_hmpc)
    density = spectrum.dimensionless * ratio**2  # dS/dlnk
    below = density[0] / (cosmology.ns + 3.0)  # k^(ns+3) down to k = 0
    steps = 0.5 * spectrum.step * (density[1:] + density[:-1])
    variance = below + np.concatenate(([0.0], np.cumsum(steps)))
    radius_mpc = sharp_k_a / (spectrum.k_hmpc * cosmology.h)
    mass = 4.0 * math.pi / 3.0 * cosmology.mean_density_msun_mpc3 * radius_mpc**3
    slope = density / (6.0 * variance)
    return SharpKVariance(np.log(mass[::-1]), np.log(variance[::-1]), slope[::-1].copy())


def top_hat_sigma(spectrum: LinearPower, radius_mpch: FloatArray) -> FloatArray:
    """Return the linear rms [n] at z = 0 of cold dark matter in spheres of comoving radius [Mpc/h], [n]."""
    x = radius_mpch[:, None] * spectrum.k_hmpc
    window = 3.0 * (np.sin(x) - x * np.cos(x)) / x**3
    small = x < 1.0e-2  # the difference cancels there
    window[small] = 1.0 - x[small] ** 2 / 10.0
    return np.sqrt(np.trapezoid(spectrum.dimensionless * window**2, dx=spectrum.step, axis=1))
