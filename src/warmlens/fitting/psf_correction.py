"""Correction of the PSF on the quasar images of the lens itself.

A PSF made elsewhere is wrong by per cents in its core, and its faint wings carry the noise of the star that it was
made of; near images a thousand times brighter than the arcs both exceed the noise. About the images the source
can follow part of the misfit, so the correction is solved for together with all other amplitudes of the model:
every pixel of the kernel within a radius is one more linear column, shared by the images, with a Gaussian prior
relative to the PSF.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import linalg, ndimage

from warmlens.fitting.image_model import ImageModel, Solution
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import point_source
from warmlens.types import BoolArray, FloatArray

_FLUX_SIGMA = 0.01  # what share of the flux may cross the radius of the correction
_FLOOR = 2e-5  # of the prior, in units of the PSF's sum: a faint pixel may be wrong by more than a fraction
_WING_BLUR_PIXELS = 3.0


@dataclass(frozen=True)
class PsfError:
    """Relative error of a PSF by distance from its centre."""

    radius: FloatArray  # outer edges of the rings [arcsec], ascending
    sigma: FloatArray  # error of the PSF in each ring, in units of its sum; 0 beyond the last

    def variance(self, grid: PixelGrid, quasars: FloatArray, fluxes: FloatArray) -> FloatArray:
        """Return the variance [ny, nx] about images at positions [n, 2] with fluxes [n], in flux squared."""
        x, y = grid.coordinates()
        distance = np.hypot(x - quasars[:, 0, None, None], y - quasars[:, 1, None, None])
        table = np.append(self.sigma, 0.0)
        sigma = table[np.searchsorted(self.radius, distance, side="right")]
        return np.sum((fluxes[:, None, None] * sigma) ** 2, axis=0)


def kernel_radius(psf: FloatArray, pixel_scale: float) -> FloatArray:
    """Return the distance of every kernel pixel from the middle one [arcsec]."""
    half = psf.shape[0] // 2
    axis = np.arange(-half, half + 1) * pixel_scale
    return np.hypot(axis[:, None], axis[None, :])


def smooth_wings(psf: FloatArray, pixel_scale: float, inner: float, outer: float) -> FloatArray:
    """Take the pixel noise out of the wings of a PSF [odd, odd]; sum 1.

    The wings are blended in between the radii `inner` and `outer` [arcsec]: the mean profile of rings plus the
    rest blurred by three pixels, which keeps spikes and drops noise.
    """
    radius = kernel_radius(psf, pixel_scale)
    edges = np.concatenate([np.arange(0.0, 1.0, pixel_scale), np.arange(1.0, radius.max() + 0.2, 0.2)])
    ring = np.digitize(radius, edges)
    counts = np.bincount(ring.ravel())
    filled = counts > 0
    middle = np.bincount(ring.ravel(), radius.ravel())[filled] / counts[filled]
    mean = np.bincount(ring.ravel(), psf.ravel())[filled] / counts[filled]
    profile = np.interp(radius, middle, mean)
    wings = profile + ndimage.gaussian_filter(psf - profile, _WING_BLUR_PIXELS)
    blend = np.clip((radius - inner) / (outer - inner), 0.0, 1.0)
    smoothed = (1.0 - blend) * psf + blend * wings
    return smoothed / smoothed.sum()


def corrected_psf(
    model: ImageModel, solution: Solution, number: int, radius: float, relative_sigma: float
) -> FloatArray:
    """Return the PSF of band `number`, corrected on the quasar images; sum 1.

    The kernel is corrected within `radius` [arcsec]; `relative_sigma` is the width of the prior on each pixel's
    correction, as a fraction of the PSF there.
    """
    band, solved = model.bands[number], solution.bands[number]
    quasars = solution.macro.quasars
    fluxes = solved.fixed_amplitudes[: len(quasars)]
    inside = kernel_radius(band.psf, model.grid.pixel_scale) <= radius
    prior = relative_sigma * np.abs(band.psf[inside]) + _FLOOR
    columns = _correction_columns(model.grid, quasars, fluxes, inside)[:, solved.pixels].T
    columns *= band.weights.ravel()[solved.pixels, None] * prior
    design = np.hstack([solved.design, columns])
    n = solved.design.shape[1]
    normal = design.T @ design
    normal[np.arange(n), np.arange(n)] += model.ridge
    normal[n:, n:] += np.eye(len(prior)) + np.outer(prior, prior) / _FLUX_SIGMA**2
    data = (band.weights * band.image).ravel()[solved.pixels]
    amplitudes = linalg.solve(normal, design.T @ data, assume_a="pos")
    psf = band.psf.copy()
    psf[inside] += amplitudes[n:] * prior
    return psf / psf.sum()


def _correction_columns(grid: PixelGrid, quasars: FloatArray, fluxes: FloatArray, inside: BoolArray) -> FloatArray:
    """Return the image of each corrected kernel pixel, all quasars together [n_kernel, npix]."""
    rows, columns = np.argwhere(inside).T - inside.shape[0] // 2
    reach = int(max(np.abs(rows).max(), np.abs(columns).max()))
    delta = np.ones((1, 1))
    images = np.zeros((rows.size, *grid.shape))
    for (x, y), flux in zip(quasars, fluxes, strict=True):
        points = np.pad(point_source(delta, grid, x, y), reach)
        shifted = sliding_window_view(points, grid.shape)
        images += flux * shifted[reach - rows, reach - columns]
    return images.reshape(rows.size, -1)


def psf_error(model: ImageModel, solution: Solution, number: int, sigma: FloatArray, radius: float) -> PsfError:
    """Measure the error left in the PSF of band `number` from what the quasar images leave over the noise.

    `sigma` is the noise without the PSF's error [ny, nx], `radius` the largest distance from an image [arcsec].

    Notes
    -----
    In rings of one pixel about all images. The correction has one free value for all n images in each kernel
    pixel, which takes 1/n of the scatter; the ring's variance is scaled back by n/(n - 1).
    A ring that scatters no more than the noise gets the error 0: nothing was measured there.
    """
    band, solved = model.bands[number], solution.bands[number]
    quasars = solution.macro.quasars
    fluxes = solved.fixed_amplitudes[: len(quasars)]
    n_rings = round(radius / model.grid.pixel_scale)
    edges = model.grid.pixel_scale * np.arange(1.0, n_rings + 1.0)
    pixels = solved.pixels
    excess = (solved.residual / band.weights.ravel()[pixels]) ** 2 - sigma.ravel()[pixels] ** 2
    x, y = (axis.ravel()[pixels] for axis in model.grid.coordinates())
    numerator, count = np.zeros(edges.size), np.zeros(edges.size)
    for (qx, qy), flux in zip(quasars, fluxes, strict=True):
        ring = np.searchsorted(edges, np.hypot(x - qx, y - qy), side="right")
        near = ring < edges.size
        numerator += np.bincount(ring[near], excess[near] / flux**2, minlength=edges.size)
        count += np.bincount(ring[near], minlength=edges.size)
    n = len(quasars)
    inflation = n / (n - 1) if n > 1 else 1.0
    variance = inflation * np.maximum(numerator, 0.0) / np.maximum(count, 1.0)
    return PsfError(edges, np.sqrt(variance))
