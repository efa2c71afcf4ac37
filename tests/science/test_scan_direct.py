"""The exact low-rank scan against a direct solver: build the perturbed design matrix, solve, subtract.

The solver shares nothing with the package but the numbers that define the problem (columns' norms and
ridge): lenstronomy's shapelets, the PSF as a dense matrix or an FFT of scipy, least squares by QR.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from lenstronomy.LensModel.lens_model import LensModel
from lenstronomy.LightModel.Profiles.shapelets import ShapeletSet as LenstronomyShapelets
from scipy import linalg, signal

from warmlens.fitting.linear import build_linear_model, physical_coefficients, solve
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import Convolution, hst_like_psf, point_source, validate_psf
from warmlens.imaging.shapelets import ShapeletSet, pixel_basis
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.maps import delta_r, residual_images
from warmlens.scan.operator import build_shard, project_band
from warmlens.scan.perturber import Perturber

THETA_E, R_TRUNC = 0.01, 0.1
TOLERANCE = 1e-4  # in units of chi2, docs/scan.md, "What is checked"


def perturbed_source(rays, center):
    """Source positions of the sub-pixels with the perturber, by the paper's formula."""
    dx, dy = rays.theta_x - center[0], rays.theta_y - center[1]
    radius = np.hypot(dx, dy)
    alpha = np.select([radius <= R_TRUNC, radius <= 2.0 * R_TRUNC], [THETA_E, THETA_E * (2.0 - radius / R_TRUNC)])
    unit = np.where(radius > 0.0, radius, np.inf)
    return rays.source_x - alpha * dx / unit, rays.source_y - alpha * dy / unit


def lenstronomy_columns(item, x, y):
    """Shapelets averaged over sub-pixels [npix, n_source]."""
    ones = np.ones(item.n_coefficients)
    functions = LenstronomyShapelets().function_split(
        x.ravel(), y.ravel(), ones, item.n_max, item.beta, item.center_x, item.center_y
    )
    return np.mean(np.array(functions).reshape(-1, *x.shape), axis=2).T


def dense_psf_matrix(psf, shape):
    """P [npix, npix], element by element."""
    rows, columns = (index.ravel() for index in np.mgrid[: shape[0], : shape[1]])
    middle = psf.shape[0] // 2
    dy = rows[:, None] - rows[None, :] + middle
    dx = columns[:, None] - columns[None, :] + middle
    inside = (dy >= 0) & (dy < psf.shape[0]) & (dx >= 0) & (dx < psf.shape[1])
    return np.where(inside, psf[np.clip(dy, 0, psf.shape[0] - 1), np.clip(dx, 0, psf.shape[1] - 1)], 0.0)


def minimum(columns, weights, norms, ridge, images):
    """J of each image [k], by the QR decomposition of the stacked system of unmasked pixels and prior."""
    unmasked = weights > 0.0
    design = (weights[:, None] * columns)[unmasked] / norms
    stacked = np.vstack([design, np.sqrt(ridge) * np.eye(norms.size)])
    data = (weights[:, None] * images)[unmasked]
    target = np.vstack([data, np.zeros((norms.size, images.shape[1]))])
    q, _ = linalg.qr(stacked, mode="economic")
    residual = target - q @ (q.T @ target)
    return np.sum(residual**2, axis=0)


def low_rank_delta_r(rays, item, fixed, psf, weights, ridge, positions, images, perturber=None):
    """Delta R [n_positions, k] by the package, with the model's column norms and number of moved pixels."""
    perturber = perturber or Perturber(THETA_E, R_TRUNC)
    convolution = Convolution(psf, weights.shape)
    model = build_linear_model(
        pixel_basis((item,), rays.source_x, rays.source_y), fixed, convolution, weights, ridge
    )
    projection = project_band(model, convolution, weights, rays, perturber)
    shard = build_shard(model, projection, weights, (item,), rays, perturber, positions)
    fit = solve(model, weights.reshape(-1, 1) * images)
    coefficients = physical_coefficients(model, fit.coefficients)[: model.n_source]
    tau = residual_images(fit, convolution, weights)
    result = delta_r(shard, (item,), rays, perturber, coefficients, tau)
    return result, model.column_norms, np.diff(shard.pixel_offsets)


QUASARS = ((0.62, 0.55), (-0.78, -0.1))
POSITIONS = {
    "on the arc": (0.83, 0.0),
    "on the arc, between sub-pixels": (-0.313, 0.741),
    "near a quasar": (0.60, 0.50),
    "near the lens centre": (0.03, -0.02),
    "at the image edge": (1.17, -0.4),
    "at the corner": (-1.19, 1.19),
    "off the arc": (0.5, -1.05),
    "partially masked": (-0.6, -0.62),
    "masked": (-0.85, -0.95),
    "off the image": (1.6, 0.0),
}


class SmallScene:
    """48 x 48 pixels, a quadruple lens, n_max 8, a PSF as large as asked, a masked corner."""

    def __init__(self, factor, psf_size):
        rng = np.random.default_rng(31)
        grid = PixelGrid.centred((48, 48), 0.05)
        theta_x, theta_y = grid.subpixel_coordinates(factor)
        lens = LensModel(["SIE", "SHEAR"])
        parameters = [
            {"theta_E": 0.8, "e1": 0.1, "e2": 0.05, "center_x": 0.0, "center_y": 0.0},
            {"gamma1": -0.05, "gamma2": 0.02},
        ]
        source = lens.ray_shooting(theta_x.ravel(), theta_y.ravel(), parameters)
        self.rays = SmoothRays(theta_x, theta_y, *(array.reshape(theta_x.shape) for array in source))
        self.item = ShapeletSet(8, 0.1, 0.03, -0.02)
        self.psf = hst_like_psf(814.0, 0.05, psf_size)
        quasars = [point_source(self.psf, grid, x, y).ravel() for x, y in QUASARS]
        self.fixed = np.stack([*quasars, np.ones(48 * 48)], axis=1)
        self.weights = 1.0 / rng.uniform(0.01, 0.02, grid.shape)
        x, y = grid.coordinates()
        self.weights[(x < -0.6) & (y < -0.6)] = 0.0
        self.ridge = 1e-8
        self.convolve = dense_psf_matrix(self.psf, grid.shape)
        # The first image plays the observation (a source the basis cannot follow), the others are mocks
        # with small random changes of the deflection and noise.
        noise = rng.normal(size=(48 * 48, 3)) * np.where(
            self.weights > 0, 1.0 / np.maximum(self.weights, 1.0), 0
        ).reshape(-1, 1)
        self.images = np.empty((48 * 48, 3))
        for k in range(3):
            bend = 0.004 * k * np.sin(9.0 * theta_x + k), 0.004 * k * np.cos(7.0 * theta_y)
            u = np.hypot(self.rays.source_x - 0.05 + bend[0], self.rays.source_y + 0.04 + bend[1])
            light = (3.0 * np.exp(-u / 0.08) + np.exp(-0.5 * ((u - 0.15) / 0.03) ** 2)).mean(axis=1)
            self.images[:, k] = self.convolve @ light + self.fixed @ [30.0, 20.0, 0.01] + noise[:, k]

    def minimum(self, source_x, source_y, norms):
        light = self.convolve @ lenstronomy_columns(self.item, source_x, source_y)
        columns = np.hstack([light, self.fixed])
        return minimum(columns, self.weights.ravel(), norms, self.ridge, self.images)


@pytest.mark.parametrize(("factor", "psf_size"), [(1, 25), (2, 25), (2, 97)])
def test_delta_r_is_the_direct_solver_s(factor, psf_size):
    scene = SmallScene(factor, psf_size)
    positions = np.array(list(POSITIONS.values()))
    arguments = (
        scene.rays, scene.item, scene.fixed, scene.psf, scene.weights, scene.ridge, positions, scene.images
    )  # fmt: skip
    result, norms, moved = low_rank_delta_r(*arguments)
    smooth = scene.minimum(scene.rays.source_x, scene.rays.source_y, norms)
    direct = np.zeros_like(result)
    for i, (name, center) in enumerate(POSITIONS.items()):
        if name == "masked":  # by definition, see build_shard
            continue
        direct[i] = scene.minimum(*perturbed_source(scene.rays, center), norms) - smooth
    for name, error, size in zip(POSITIONS, np.abs(result - direct).max(axis=1), moved, strict=True):
        assert error < TOLERANCE, f"{name}: {error:.1e} with {size} moved pixels"
        assert (size == 0) == (name in ("masked", "off the image")), name
    np.testing.assert_array_equal(result[-2:], 0.0)
    # The agreement means something: the values are far above the tolerance, and another clump has others.
    assert np.median(np.abs(direct[:8])) > 1e3 * TOLERANCE
    assert np.abs(direct).max() > 1.0
    other, _, _ = low_rank_delta_r(*arguments, perturber=Perturber(1.01 * THETA_E, R_TRUNC))
    assert np.abs(other - direct).max() > 100.0 * TOLERANCE


def test_delta_r_on_the_real_image():
    """RXJ1131-1231, F814W, 160 x 160 pixels, n_max 20, one observation and two mocks, five positions."""
    if "WARMLENS_HST_DATA" not in os.environ:
        pytest.skip("WARMLENS_HST_DATA does not point to a folder with sci.fits, psf.fits, arc_mask.fits")
    from astropy.io import fits

    folder = Path(os.environ["WARMLENS_HST_DATA"])
    image = fits.getdata(folder / "sci.fits").astype(np.float64)
    psf = validate_psf(fits.getdata(folder / "psf.fits"), "F814W")
    mask = fits.getdata(folder / "arc_mask.fits") > 0
    grid = PixelGrid(160, 160, 0.05, 0.05 - 4.42, 0.05 - 3.932)
    weights = mask / np.sqrt(0.0082**2 + np.maximum(image, 0.0) / 1980.0)
    theta_x, theta_y = grid.subpixel_coordinates(1)
    lens = LensModel(["EPL", "SHEAR", "SIS"])
    parameters = [
        {"theta_E": 1.634, "gamma": 1.957, "e1": 0.0831, "e2": 0.1065, "center_x": 0.0, "center_y": 0.0},
        {"gamma1": -0.0841, "gamma2": -0.0054},
        {"theta_E": 0.213, "center_x": -0.097, "center_y": 0.614},
    ]
    source = lens.ray_shooting(theta_x.ravel(), theta_y.ravel(), parameters)
    rays = SmoothRays(theta_x, theta_y, *(array.reshape(theta_x.shape) for array in source))
    item = ShapeletSet(20, 0.18, -0.503, -0.058)
    quasars = ((-2.037, -0.520), (-2.076, 0.662), (-1.460, -1.632), (1.074, 0.356))
    fixed = np.stack([*(point_source(psf, grid, *xy).ravel() for xy in quasars), np.ones(image.size)], axis=1)
    noise = np.random.default_rng(2).normal(size=(image.size, 2))
    scale = np.divide(1.0, weights, out=np.zeros_like(weights), where=mask).reshape(-1, 1)
    images = np.hstack([image.reshape(-1, 1), 0.9 * image.reshape(-1, 1) + scale * noise])
    positions = np.array([(-2.2, 0.1), (-2.0, -0.45), (0.9, 0.3), (-0.5, -2.1), (0.0, 1.9)])

    ridge = 1e-8
    result, norms, moved = low_rank_delta_r(rays, item, fixed, psf, weights, ridge, positions, images)

    def direct_minimum(source_x, source_y):
        light = lenstronomy_columns(item, source_x, source_y).T.reshape(-1, 160, 160)
        convolved = np.stack([signal.fftconvolve(function, psf, mode="full") for function in light])
        columns = convolved[:, 80:240, 80:240].reshape(-1, image.size).T
        return minimum(np.hstack([columns, fixed]), weights.ravel(), norms, ridge, images)

    smooth = direct_minimum(rays.source_x, rays.source_y)
    for i, center in enumerate(positions):
        direct = direct_minimum(*perturbed_source(rays, center)) - smooth
        assert moved[i] > 30
        assert np.abs(result[i] - direct).max() < TOLERANCE, center
