"""What a population of subhaloes adds to the smooth deflection of an image."""

from __future__ import annotations

import numpy as np

from warmlens.cosmology import LensGeometry
from warmlens.halos.population import Subhalos
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.deflection import tnfw_angular_scales, tnfw_convergence, tnfw_deflection
from warmlens.lensing.high_pass import crop, high_pass, margin_pixels
from warmlens.types import FloatArray


def filtered_deflection(
    subhalos: Subhalos, grid: PixelGrid, geometry: LensGeometry, filter_arcsec: float
) -> FloatArray:
    """High-pass filtered deflection of all subhaloes at the pixel centres.

    Parameters
    ----------
    subhalos
        Subhaloes of the field.
    grid
        Pixels of the image; the deflection is computed on a margin around it, so that the filter has no edge.
    geometry
        Angular scale and critical surface density.
    filter_arcsec
        Standard deviation of the Gaussian that is taken off.

    Returns
    -------
    delta_alpha
        [2, ny, nx] (x, y) [arcsec].

    Reference: Birrer+2017 sec. 3.2, Delta alpha_dm.
    """
    margin = margin_pixels(filter_arcsec, grid.pixel_scale)
    x, y = grid.padded(margin).coordinates()
    alpha = tnfw_deflection(x, y, subhalos.x_arcsec, subhalos.y_arcsec, *_scales(subhalos, geometry))
    return crop(high_pass(alpha, filter_arcsec, grid.pixel_scale), margin)


def convergence_map(subhalos: Subhalos, grid: PixelGrid, geometry: LensGeometry) -> FloatArray:
    """Convergence [ny, nx] of all subhaloes at the pixel centres."""
    x, y = grid.coordinates()
    return tnfw_convergence(x, y, subhalos.x_arcsec, subhalos.y_arcsec, *_scales(subhalos, geometry))


def required_half_width(grid: PixelGrid, filter_arcsec: float) -> float:
    """Half-width [arcsec] of the field that subhaloes must fill: the image and three filter widths."""
    x, y = grid.coordinates()
    return float(max(np.abs(x).max(), np.abs(y).max()) + 0.5 * grid.pixel_scale + 3.0 * filter_arcsec)


def _scales(subhalos: Subhalos, geometry: LensGeometry) -> tuple[FloatArray, FloatArray, FloatArray]:
    return tnfw_angular_scales(
        subhalos.r_s_kpc,
        subhalos.r_t_kpc,
        subhalos.rho_s,
        geometry.kpc_per_arcsec,
        geometry.sigma_crit_msun_kpc2,
    )
