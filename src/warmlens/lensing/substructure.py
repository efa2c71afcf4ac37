"""What a halo and its subhalos add to the smooth deflection of an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warmlens.cosmology import Cosmology, LensGeometry
from warmlens.halos.lens_halo import Subhalos
from warmlens.halos.profiles import nfw_mass, nfw_norm
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.deflection import tnfw_angular_scales, tnfw_convergence
from warmlens.lensing.high_pass import FilterKind, crop, high_pass, margin_pixels
from warmlens.lensing.pixel_mean import pixel_deflection
from warmlens.types import FloatArray

HOST_TRUNCATION = 1.0e3  # r_t / r_s of a smooth host: within the field its profile is NFW to a few 1e-6


@dataclass(frozen=True)
class SmoothHost:
    """NFW profile of what a halo holds besides its subhalos, about the origin of the subhalos' positions.

    Attributes
    ----------
    r_s_kpc
        Scale radius [kpc].
    rho_s
        Scale density [Msun/kpc^3].
    """

    r_s_kpc: float
    rho_s: float

    @classmethod
    def of_halo(
        cls, m_halo_msun: float, concentration: float, f_sub: float, cosmology: Cosmology, z_lens: float
    ) -> SmoothHost:
        """Profile of a halo of mass M200c [Msun], concentration R200c/r_s and mass fraction f_sub in subhalos.

        The subhalos' mass is taken off at all radii alike, so that both together hold M200c.
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
    """High-pass filtered deflection of all subhalos at the pixels.

    Parameters
    ----------
    subhalos
        Subhalos of the field.
    grid
        Pixels of the image; the deflection is computed on a margin around it, so that the filter has no edge.
    geometry
        Angular scale and critical surface density.
    filter_arcsec
        Standard deviation of the Gaussian that is taken off.
    kind
        Filter, see `high_pass`.
    host
        Deflects too, before the filter; None: the smooth lens model holds all of it.

    Returns
    -------
    delta_alpha
        [2, ny, nx] (x, y) [arcsec]: at the pixel centres, a mean over the pixel near narrow halos
        (`pixel_deflection`).

    Reference: Birrer+2017 sec. 3.2, Delta alpha_dm.
    """
    margin = margin_pixels(filter_arcsec, grid.pixel_scale, kind)
    x, y = subhalos.x_arcsec, subhalos.y_arcsec
    r_s, rho_s, r_t = subhalos.r_s_kpc, subhalos.rho_s, subhalos.r_t_kpc
    if host is not None:
        x, y = np.append(x, 0.0), np.append(y, 0.0)
        r_s, rho_s = np.append(r_s, host.r_s_kpc), np.append(rho_s, host.rho_s)
        r_t = np.append(r_t, HOST_TRUNCATION * host.r_s_kpc)
    scales = tnfw_angular_scales(r_s, r_t, rho_s, geometry.kpc_per_arcsec, geometry.sigma_crit_msun_kpc2)
    alpha = pixel_deflection(grid.padded(margin), x, y, *scales)
    return crop(high_pass(alpha, filter_arcsec, grid.pixel_scale, kind), margin)


def convergence_map(subhalos: Subhalos, grid: PixelGrid, geometry: LensGeometry) -> FloatArray:
    """Convergence [ny, nx] of all subhalos at the pixel centres."""
    scales = tnfw_angular_scales(
        subhalos.r_s_kpc,
        subhalos.r_t_kpc,
        subhalos.rho_s,
        geometry.kpc_per_arcsec,
        geometry.sigma_crit_msun_kpc2,
    )
    return tnfw_convergence(*grid.coordinates(), subhalos.x_arcsec, subhalos.y_arcsec, *scales)


def required_half_width(grid: PixelGrid, filter_arcsec: float) -> float:
    """Half-width [arcsec] of the field that subhalos must fill: the image and three filter widths."""
    x, y = grid.coordinates()
    return float(max(np.abs(x).max(), np.abs(y).max()) + 0.5 * grid.pixel_scale + 3.0 * filter_arcsec)
