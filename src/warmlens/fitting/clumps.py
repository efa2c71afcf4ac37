"""Small features of the source that the global shapelets miss: where they are, and a shapelet set for each."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from warmlens.config.smooth_model import ClumpsBlock
from warmlens.fitting.image_model import ImageModel, Solution
from warmlens.imaging.psf import Convolution, fwhm
from warmlens.imaging.shapelets import ShapeletSet
from warmlens.lensing.macro_model import deflection
from warmlens.types import BoolArray, FloatArray

_JACOBIAN_STEP = 0.01  # arcsec
_SCALE_IN_RAYS = 0.5  # a Gaussian that is sampled so is known to 1.4%, a finer one to nothing
_SEPARATION = 1.5  # of two clumps, in units of the larger scale


def find_clumps(
    model: ImageModel, solution: Solution, clumps: ClumpsBlock, excluded: BoolArray
) -> tuple[ShapeletSet, ...]:
    """Return sets for the most significant residual features, traced to the source plane and merged there.

    Parameters
    ----------
    model, solution
        Smooth model and its best amplitudes.
    clumps
        How many at most (Birrer+2017 sec. 2: 15), their order, and `threshold`: the smallest significance of a
        residual peak, matched to the PSF and added in quadrature over the bands. The scale of a set is
        `scale_in_fwhm` times the FWHM of the PSF over sqrt(magnification), the magnified resolution; at least half
        the distance of rays in the source along the axis that is magnified least. Near a critical curve the first
        alone would make a set so small that it fits single pixels with any amplitude.
    excluded
        Pixels whose peaks are not taken: cores of the quasars [ny, nx]. Those without weight are not taken either.

    Returns
    -------
    tuple
        Sets with scales, and centres relative to the solution's, in units of its source scale; most significant
        first.
    """
    weighted = np.any([band.weights > 0.0 for band in model.bands], axis=0)
    significance = np.where(excluded | ~weighted, 0.0, residual_significance(model, solution))
    peaks = (significance == ndimage.maximum_filter(significance, 3)) & (significance > clumps.threshold)
    order = np.argsort(-significance[peaks], kind="stable")
    x, y = (axis[peaks][order] for axis in model.grid.coordinates())
    source, shrinking = _trace(model, solution, x, y)
    resolution = clumps.scale_in_fwhm * fwhm(model.bands[0].psf, model.grid.pixel_scale)
    rays = model.grid.pixel_scale / model.supersampling * shrinking.max(axis=-1)
    scales = np.maximum(resolution * np.sqrt(shrinking.prod(axis=-1)), _SCALE_IN_RAYS * rays)
    kept: list[int] = []
    for i in range(x.size):
        if len(kept) == clumps.number:
            break
        distance = np.hypot(*(source[:, kept] - source[:, [i]]))
        if np.all(distance > _SEPARATION * np.maximum(scales[kept], scales[i])):
            kept.append(i)
    beta = solution.macro.beta
    relative = (source - solution.center[:, None]) / beta
    return tuple(
        ShapeletSet(clumps.n_max, float(scales[i]) / beta, float(relative[0, i]), float(relative[1, i]))
        for i in kept
    )


def residual_significance(model: ImageModel, solution: Solution) -> FloatArray:
    """Return the significance of a point-like residual at every pixel, all bands in quadrature [ny, nx]."""
    total = np.zeros(model.grid.shape)
    for band, convolution, solved in zip(model.bands, model.convolutions, solution.bands, strict=True):
        residual = np.zeros(band.weights.size)
        residual[solved.pixels] = solved.residual
        score = convolution.adjoint(band.weights * residual.reshape(model.grid.shape))
        information = Convolution(band.psf**2, model.grid.shape).adjoint(band.weights**2)
        total += np.where(information > 1e-6 * information.max(), score**2 / np.maximum(information, 1e-300), 0.0)
    return np.sqrt(total)


def _trace(model: ImageModel, solution: Solution, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return source positions [2, n] of points on the sky, and how lengths shrink along two axes there [n, 2]."""
    step = _JACOBIAN_STEP
    offsets = np.array([(0.0, 0.0), (step, 0.0), (-step, 0.0), (0.0, step), (0.0, -step)])
    points_x, points_y = x + offsets[:, :1], y + offsets[:, 1:]
    alpha = deflection(model.lens_models, solution.macro.kwargs_lens, points_x, points_y)
    traced = np.array([points_x, points_y]) - alpha
    along_x = (traced[:, 1] - traced[:, 2]) / (2.0 * step)
    along_y = (traced[:, 3] - traced[:, 4]) / (2.0 * step)
    return traced[:, 0], np.linalg.svd(np.array([along_x, along_y]).T, compute_uv=False)
