"""Where subhaloes lie in their host, and on the sky."""

from __future__ import annotations

import math

import numpy as np

from warmlens.halos.profiles import nfw_mass
from warmlens.types import FloatArray


def nfw_inverse_mass(mass: FloatArray) -> FloatArray:
    """x = r/r_s within which an NFW profile holds the mass [4 pi rho_s r_s^3]; inverse of `nfw_mass`."""
    from scipy.special import lambertw

    argument: FloatArray = -np.exp(-1.0 - mass)
    return -1.0 - 1.0 / lambertw(argument, 0).real


def draw_nfw_radii(
    radius_kpc: FloatArray | float,
    concentration: FloatArray | float,
    count: int,
    rng: np.random.Generator,
) -> FloatArray:
    """Radii [kpc] of `count` points that follow the mass of NFW hosts within R200c.

    Parameters
    ----------
    radius_kpc, concentration
        R200c [kpc] and concentration of the host, one for all points or one a point.
    count
        Number of points.
    rng
        Random numbers.
    """
    enclosed = rng.random(count) * nfw_mass(concentration)
    return np.asarray(radius_kpc) * nfw_inverse_mass(enclosed) / concentration


def project_isotropically(radii: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Two Cartesian coordinates of points at the given radii in isotropic directions, in the same unit."""
    cos_theta = rng.uniform(-1.0, 1.0, radii.size)
    phi = rng.uniform(0.0, 2.0 * math.pi, radii.size)
    projected = radii * np.sqrt(1.0 - cos_theta**2)
    return projected * np.cos(phi), projected * np.sin(phi)
