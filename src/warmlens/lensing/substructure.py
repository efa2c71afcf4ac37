"""What a halo and its subhalos add to the smooth deflection of an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warmlens.cosmology import Cosmology, LensGeometry
from warmlens.halos.lens_halo import Subhalos
from warmlens.halos.profiles import nfw_mass, nfw_norm
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.deflection import TnfwHalos, tnfw_angular_scales, tnfw_convergence
from warmlens.lensing.high_pass import FilterKind, crop, high_pass, margin_pixels
from warmlens.lensing.pixel_mean import pixel_deflection
from warmlens.types import FloatArray

HOST_TRUNCATION = 1.0e3  # r_t / r_s of a smooth host: within the field its profile is NFW to a few 1e-6


@dataclass(frozen=True)
class SmoothHost:
    """NFW profile of what a halo holds besides its subhalos, about the origin of the subhalos' positions."""

    r_s_kpc: float
    rho_s: float  # scale density [Msun/kpc^3]

    @classmethod
    def of_halo(
        cls, m_halo_msun: float, concentration: float, f_sub: float, cosmology: Cosmology, z_lens: float
    ) -> SmoothHost:
        """Return the profile for M200c [Msun], concentration R200c/r_s and mass fraction f_sub in subhalos.

        The mass of the subhalos is subtracted at all radii alike, so that both together hold M200c.
        """
        if not (m_halo_msun > 0.0 and concentration > 0.0 and 0.0 <= f_sub < 1.0):
            raise ValueError(
                "a smooth host needs m_halo_msun > 0, concentration > 0 and 0 <= f_sub < 1, got "
                f"{m_halo_msun!r}, {concentration!r} and {f_sub!r}; without it: deflections.smooth_host: false"
            )
        r_s = float(cosmology.radius_200c(m_halo_msun, z_lens)) / concentration
        mass = float(nfw_norm(np.array(r_s), np.array(1.0)) * nfw_mass(concentration))  # for rho_s = 1
        return cls(r_s, (1.0 - f_sub) * m_halo_msun / mass)


def filtered_deflection(
    subhalos: Subhalos,
    grid: PixelGrid,
    geometry: LensGeometry,
    filter_arcsec: float,
    kind: FilterKind = "gaussian",
    host: SmoothHost | None = None,
) -> FloatArray:
    """Return the high-pass filtered deflection of all subhalos at the pixels, [2, ny, nx] (x, y) [arcsec].

    Parameters
    ----------
    grid
        Pixels of the image; the deflection is computed on a margin around it, so that the filter has no edge.
    filter_arcsec
        Standard deviation of the Gaussian filter [arcsec].
    kind
        Filter, see `high_pass`.
    host
        Deflects too, before the filter. None: the smooth lens model holds all of it.

    Reference: Birrer+2017 sec. 3.2, Delta alpha_dm.
    """
    margin = margin_pixels(filter_arcsec, grid.pixel_scale, kind)
    alpha = pixel_deflection(grid.padded(margin), _halos_on_sky(subhalos, geometry, host))
    return crop(high_pass(alpha, filter_arcsec, grid.pixel_scale, kind), margin)


def convergence_map(subhalos: Subhalos, grid: PixelGrid, geometry: LensGeometry) -> FloatArray:
    """Return the convergence [ny, nx] of all subhalos at the pixel centres."""
    return tnfw_convergence(*grid.coordinates(), _halos_on_sky(subhalos, geometry))


def _halos_on_sky(subhalos: Subhalos, geometry: LensGeometry, host: SmoothHost | None = None) -> TnfwHalos:
    x, y = subhalos.x_arcsec, subhalos.y_arcsec
    r_s, rho_s, r_t = subhalos.r_s_kpc, subhalos.rho_s, subhalos.r_t_kpc
    if host is not None:
        x, y = np.append(x, 0.0), np.append(y, 0.0)
        r_s, rho_s = np.append(r_s, host.r_s_kpc), np.append(rho_s, host.rho_s)
        r_t = np.append(r_t, HOST_TRUNCATION * host.r_s_kpc)
    scales = tnfw_angular_scales(r_s, r_t, rho_s, geometry.kpc_per_arcsec, geometry.sigma_crit_msun_kpc2)
    return TnfwHalos(x, y, *scales)


def required_half_width(grid: PixelGrid, filter_arcsec: float) -> float:
    """Return the half-width [arcsec] of the field that subhalos must fill: the image and three filter widths."""
    x, y = grid.coordinates()
    return float(max(np.abs(x).max(), np.abs(y).max()) + 0.5 * grid.pixel_scale + 3.0 * filter_arcsec)
