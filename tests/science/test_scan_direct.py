"""The exact low-rank scan against a direct solver: build the perturbed design matrix, solve, subtract.

The solver shares nothing with the package but the numbers that define the problem (weights of the prior,
centres and scales of the nested shapelets): lenstronomy's shapelets, the PSF as a dense matrix or an FFT of
scipy, least squares by QR.
"""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from lenstronomy.LensModel.lens_model import LensModel
from lenstronomy.LightModel.Profiles.shapelets import Shapelets as LenstronomyShapelet
from lenstronomy.LightModel.Profiles.shapelets import ShapeletSet as LenstronomyShapelets
from scipy import linalg, signal

from warmlens.fitting.linear import build_linear_model, physical_coefficients, solve
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import Convolution, hst_like_psf, point_source, validate_psf
from warmlens.imaging.shapelets import ShapeletSet, pixel_basis
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.apply import delta_r
from warmlens.scan.maps import ResidualMaps, residual_images, residual_maps
from warmlens.scan.nested import NestedShapelets
from warmlens.scan.operator import build_shard, project_band
from warmlens.scan.perturber import Perturber
from warmlens.scan.shard import OperatorShard, ScanBand

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
    shapelets = LenstronomyShapelets()
    # By default functions of low order end 5 scales from the centre, at 4e-6 of their maximum.
    shapelets.shapelets = LenstronomyShapelet(precalc=True, stable_cut=False)
    functions = shapelets.function_split(
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


class Direct(NamedTuple):
    """Best fit of k images: J [k], penalty [k] and whitened model of the unmasked pixels [n, k]."""

    minimum: np.ndarray
    chi2: np.ndarray
    model: np.ndarray


def solve_directly(columns, weights, prior, images):
    """Least squares by QR of the stacked system of unmasked pixels and prior; columns and prior unscaled."""
    unmasked = weights > 0.0
    design = (weights[:, None] * columns)[unmasked]
    norms = np.linalg.norm(design, axis=0)
    stacked = np.vstack([design / norms, np.diag(np.sqrt(prior) / norms)])
    data = (weights[:, None] * images)[unmasked]
    target = np.vstack([data, np.zeros((norms.size, images.shape[1]))])
    q, _ = linalg.qr(stacked, mode="economic")
    fitted = q @ (q.T @ target)
    residual = target - fitted
    n = data.shape[0]
    return Direct(np.sum(residual**2, axis=0), np.sum(residual[:n] ** 2, axis=0), fitted[:n])


class LowRank(NamedTuple):
    """What the package finds, and the numbers that define the problem it solved."""

    delta_r: np.ndarray
    residuals: ResidualMaps
    shard: OperatorShard
    prior: np.ndarray  # of the unscaled coefficients


def low_rank(rays, item, fixed, psf, weights, ridge, positions, images, perturber=None, nested=None, macro=None):
    """Delta R and residual maps [n_positions, k] by the package."""
    perturber = perturber or Perturber(THETA_E, R_TRUNC)
    convolution = Convolution(psf, weights.shape)
    sigma = np.full(fixed.shape[1], np.inf)
    if macro is not None:
        fixed, sigma = np.hstack([fixed, macro]), np.append(sigma, np.ones(macro.shape[1]))
    columns = pixel_basis((item,), rays.source_x, rays.source_y)
    model = build_linear_model(columns, fixed, convolution, weights, ridge, sigma)
    band = ScanBand(model, (item,), rays, perturber, convolution, weights)
    shard = build_shard(band, project_band(band), positions, nested)
    fit = solve(model, weights.reshape(-1, 1) * images)
    coefficients = physical_coefficients(model, fit.coefficients)[: model.n_source]
    return LowRank(
        delta_r(shard, band, coefficients, residual_images(fit, convolution, weights)),
        residual_maps(shard, band, fit),
        shard,
        model.prior * model.column_norms**2,
    )


QUASARS = ((0.62, 0.55), (-0.78, -0.1))
POSITIONS = {
    "on the arc": (0.83, 0.0),
    "on the arc, between sub-pixels": (-0.313, 0.741),
    "on the other side of the arc": (-0.8, 0.25),
    "inside the arc": (0.4, -0.3),
    "near a quasar": (0.60, 0.50),
    "near the other quasar": (-0.75, -0.05),
    "near the lens centre": (0.03, -0.02),
    "on the satellite": (-0.1, 0.45),
    "at the image edge": (1.17, -0.4),
    "at the corner": (-1.19, 1.19),
    "off the arc": (0.5, -1.05),
    "partially masked": (-0.6, -0.62),
    "beside the mask": (-0.45, -0.75),
    "masked": (-0.85, -0.95),
    "off the image": (1.6, 0.0),
}
NESTED = NestedShapelets(5, 1e-5, (0.02, 0.1))


class SmallScene:
    """48 x 48 pixels, a quadruple lens with a satellite, n_max 8, a PSF as large as asked, a masked corner."""

    def __init__(self, factor, psf_size, band=0):
        rng = np.random.default_rng(31 + band)
        grid = PixelGrid.centred((48, 48), 0.05)
        theta_x, theta_y = grid.subpixel_coordinates(factor)
        self.item = ShapeletSet(8, 0.1, 0.03, -0.02)
        self.psf = hst_like_psf((814.0, 555.0)[band], 0.05, psf_size)
        quasars = [point_source(self.psf, grid, x, y).ravel() for x, y in QUASARS]
        self.fixed = np.stack([*quasars, np.ones(48 * 48)], axis=1)
        self.weights = 1.0 / rng.uniform(0.01, 0.02, grid.shape)
        x, y = grid.coordinates()
        self.weights[(x < -0.6) & (y < -0.6)] = 0.0
        self.ridge = 1e-8
        self.convolve = dense_psf_matrix(self.psf, grid.shape)
        self.band = band
        self.rays = self.shoot(theta_x, theta_y)
        # The first image plays the observation (a source the basis cannot follow), the others are mocks
        # with small random changes of the deflection and noise.
        noise = rng.normal(size=(48 * 48, 3)) * np.where(
            self.weights > 0, 1.0 / np.maximum(self.weights, 1.0), 0
        ).reshape(-1, 1)
        self.images = np.empty((48 * 48, 3))
        for k in range(3):
            bend = 0.004 * k * np.sin(9.0 * theta_x + k), 0.004 * k * np.cos(7.0 * theta_y)
            light = self.light(self.rays.source_x + bend[0], self.rays.source_y + bend[1])
            self.images[:, k] = self.convolve @ light + self.fixed @ [30.0, 20.0, 0.01] + noise[:, k]
        # Derivatives with respect to three lens parameters, for one standard deviation of each.
        self.macro = np.empty((48 * 48, 3))
        for k, change in enumerate(({"theta_E": 2e-3}, {"e1": 4e-3}, {"gamma2": 1e-3})):
            moved = self.shoot(theta_x, theta_y, **change)
            light = self.light(moved.source_x, moved.source_y) - self.light(self.rays.source_x, self.rays.source_y)
            self.macro[:, k] = self.convolve @ light

    def shoot(self, theta_x, theta_y, theta_E=0.0, e1=0.0, gamma2=0.0):
        parameters = [
            {"theta_E": 0.8 + theta_E, "e1": 0.1 + e1, "e2": 0.05, "center_x": 0.0, "center_y": 0.0},
            {"gamma1": -0.05, "gamma2": 0.02 + gamma2},
            {"theta_E": 0.06, "center_x": -0.1, "center_y": 0.45},
        ]
        source = LensModel(["SIE", "SHEAR", "SIS"]).ray_shooting(theta_x.ravel(), theta_y.ravel(), parameters)
        return SmoothRays(theta_x, theta_y, *(array.reshape(theta_x.shape) for array in source))

    def light(self, source_x, source_y):
        u = np.hypot(source_x - 0.05, source_y + 0.04)
        knots = (1.0 + self.band) * np.exp(-0.5 * ((u - 0.15) / 0.03) ** 2)
        return (3.0 * np.exp(-u / 0.08) + knots).mean(axis=1)

    def arguments(self, positions):
        return self.rays, self.item, self.fixed, self.psf, self.weights, self.ridge, positions, self.images

    def columns(self, item, source):
        return self.convolve @ lenstronomy_columns(item, *source)

    def whitened_norms(self, columns):
        return np.linalg.norm(self.weights.reshape(-1, 1) * columns, axis=0)

    def direct(self, source, prior, macro, nested_item=None, nested_prior=0.0):
        """Fit with the source basis, fixed columns, and (if given) macro and nested columns."""
        parts = [self.columns(self.item, source), self.fixed, *([self.macro] if macro else [])]
        if nested_item is not None:
            parts.append(self.columns(nested_item, source))
            prior = np.append(prior, np.full(nested_item.n_coefficients, nested_prior))
        return solve_directly(np.hstack(parts), self.weights.ravel(), prior, self.images)


def nested_of(scene, point):
    """Shapelets at one position's point and their prior, by the definition of docs/scan.md."""
    item = ShapeletSet(NESTED.n_max, point[2], point[0], point[1])
    columns = scene.columns(item, (scene.rays.source_x, scene.rays.source_y))
    return item, NESTED.ridge * scene.whitened_norms(columns).max() ** 2


@pytest.mark.parametrize("macro", [False, True], ids=["", "macro"])
@pytest.mark.parametrize("nested", [False, True], ids=["", "nested"])
@pytest.mark.parametrize(("factor", "psf_size", "band"), [(1, 25, 0), (2, 25, 1), (2, 97, 0)])
def test_scan_is_the_direct_solver_s(factor, psf_size, band, nested, macro):
    """Delta R to 1e-4 and R_sens to 1e-6 at every kind of position, for an observation and two mocks."""
    scene = SmallScene(factor, psf_size, band)
    positions = np.array(list(POSITIONS.values()))
    options = {"nested": NESTED if nested else None, "macro": scene.macro if macro else None}
    result = low_rank(*scene.arguments(positions), **options)
    smooth_source = scene.rays.source_x, scene.rays.source_y
    plain = scene.direct(smooth_source, result.prior, macro)
    direct = np.zeros_like(result.delta_r)
    for i, (name, center) in enumerate(POSITIONS.items()):
        moved = np.diff(result.shard.pixel_offsets)[i]
        assert (moved == 0) == (name in ("masked", "off the image")), name
        if moved == 0:  # by definition, see build_shard
            assert np.all(result.delta_r[i] == 0.0)
            assert np.all(result.residuals.r_sens[i] == 0.0)
            np.testing.assert_allclose(result.residuals.r_smooth[i], plain.chi2, rtol=1e-10)
            np.testing.assert_array_equal(result.residuals.r_pert[i], result.residuals.r_smooth[i])
            continue
        extra = nested_of(scene, result.shard.points[i]) if nested else ()
        smooth = scene.direct(smooth_source, result.prior, macro, *extra) if nested else plain
        pert = scene.direct(perturbed_source(scene.rays, center), result.prior, macro, *extra)
        direct[i] = pert.minimum - smooth.minimum
        error = np.abs(result.delta_r[i] - direct[i]).max()
        assert error < TOLERANCE, f"{name}: {error:.1e} with {moved} moved pixels"
        r_sens = np.sum((pert.model - smooth.model) ** 2, axis=0)
        np.testing.assert_allclose(result.residuals.r_sens[i], r_sens, rtol=1e-6, atol=1e-8, err_msg=name)
        for found, expected in ((result.residuals.r_smooth, smooth), (result.residuals.r_pert, pert)):
            np.testing.assert_allclose(found[i], expected.chi2, rtol=0, atol=TOLERANCE, err_msg=name)
    # The agreement means something: the values are far above the tolerance, and another clump has others.
    assert np.median(np.abs(direct[:8])) > 1e3 * TOLERANCE
    assert np.abs(direct).max() > 1.0
    other = low_rank(*scene.arguments(positions), **options, perturber=Perturber(1.01 * THETA_E, R_TRUNC))
    assert np.abs(other.delta_r - direct).max() > 100.0 * TOLERANCE


def test_wrong_twins_of_the_nested_fit_differ():
    """Nested shapelets in one fit alone, not perturbed, or with another prior: none passes for the scan."""
    scene = SmallScene(1, 25)
    positions = np.array(list(POSITIONS.values()))[:5]
    result = low_rank(*scene.arguments(positions), nested=NESTED)
    smooth_source = scene.rays.source_x, scene.rays.source_y
    plain = scene.direct(smooth_source, result.prior, False)
    errors = {"pert alone": [], "smooth alone": [], "none": [], "stronger prior": []}
    for i, center in enumerate(positions):
        item, weight = nested_of(scene, result.shard.points[i])
        bent = perturbed_source(scene.rays, center)
        pert, smooth = (scene.direct(s, result.prior, False, item, weight) for s in (bent, smooth_source))
        bare = scene.direct(bent, result.prior, False)
        strong = [scene.direct(s, result.prior, False, item, 1e3 * weight) for s in (bent, smooth_source)]
        twins = {
            "pert alone": pert.minimum - plain.minimum,
            "smooth alone": bare.minimum - smooth.minimum,
            "none": bare.minimum - plain.minimum,
            "stronger prior": strong[0].minimum - strong[1].minimum,
        }
        for name, twin in twins.items():
            errors[name].append(np.abs(twin - result.delta_r[i]).min())
        assert np.abs(pert.minimum - smooth.minimum - result.delta_r[i]).max() < TOLERANCE
    for name, values in errors.items():
        assert np.median(values) > 10.0 * TOLERANCE, name


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
    result = low_rank(rays, item, fixed, psf, weights, ridge, positions, images)

    def direct_minimum(source_x, source_y):
        light = lenstronomy_columns(item, source_x, source_y).T.reshape(-1, 160, 160)
        convolved = np.stack([signal.fftconvolve(function, psf, mode="full") for function in light])
        columns = convolved[:, 80:240, 80:240].reshape(-1, image.size).T
        return solve_directly(np.hstack([columns, fixed]), weights.ravel(), result.prior, images).minimum

    smooth = direct_minimum(rays.source_x, rays.source_y)
    for i, center in enumerate(positions):
        direct = direct_minimum(*perturbed_source(rays, center)) - smooth
        assert np.diff(result.shard.pixel_offsets)[i] > 30
        assert np.abs(result.delta_r[i] - direct).max() < TOLERANCE, center
