"""Linear response of the scan against finite differences of direct solves, injected perturbers and noise draws.

The direct solver builds the perturbed design matrix with a dense PSF matrix and solves by QR; it knows nothing
of the operator but the centres and scales of the nested shapelets and the weights of the priors.
"""

import dataclasses

import numpy as np
import pytest
from lenstronomy.LensModel.lens_model import LensModel
from scipy import linalg

from warmlens.fitting.linear import build_linear_model, physical_coefficients, solve
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import Convolution, hst_like_psf, point_source
from warmlens.imaging.shapelets import ShapeletSet, pixel_basis
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.apply import delta_r, delta_r_and_response
from warmlens.scan.maps import residual_images
from warmlens.scan.nested import NestedShapelets
from warmlens.scan.operator import build_shard, project_band
from warmlens.scan.perturber import Perturber
from warmlens.scan.response import LinearResponse, expected_delta_r
from warmlens.scan.shard import ScanBand

PERTURBER = Perturber(0.01, 0.1)
NESTED = NestedShapelets(5, 1e-5, (0.02, 0.1))
POSITIONS = np.array(
    [
        (0.83, 0.0),  # on the arc
        (-0.313, 0.741),  # on the arc, between sub-pixels
        (-0.8, 0.25),  # on the other side
        (0.60, 0.50),  # near a quasar
        (0.03, -0.02),  # near the lens centre
        (1.07, -0.4),  # at the image edge
        (0.5, -1.0),  # off the arc
        (-0.6, -0.62),  # partially masked
        (-0.9, -0.95),  # masked
    ]
)
MASKED = 8


class Scene:
    """44 x 44 pixels, 4 sub-pixels each; 3 macro columns with a prior; a masked corner."""

    def __init__(self, band=0, n_max=8):
        self.grid = PixelGrid.centred((44, 44), 0.05)
        theta_x, theta_y = self.grid.subpixel_coordinates(2)
        self.sets = (ShapeletSet(n_max, 0.1, 0.03, -0.02),)
        self.psf = hst_like_psf((814.0, 555.0)[band], 0.05, 21)
        self.convolution = Convolution(self.psf, self.grid.shape)
        npix = self.grid.ny * self.grid.nx
        self.dense = self.convolution.forward(np.eye(npix).reshape(npix, *self.grid.shape)).reshape(npix, npix).T
        self.weights = 1.0 / np.random.default_rng(3 + band).uniform(0.01, 0.02, self.grid.shape)
        x, y = self.grid.coordinates()
        self.weights[(x < -0.6) & (y < -0.6)] = 0.0
        parameters = [
            {"theta_E": 0.8, "e1": 0.1, "e2": 0.05, "center_x": 0.0, "center_y": 0.0},
            {"gamma1": -0.05, "gamma2": 0.02},
        ]
        source = LensModel(["SIE", "SHEAR"]).ray_shooting(theta_x.ravel(), theta_y.ravel(), parameters)
        self.rays = SmoothRays(theta_x, theta_y, *(array.reshape(theta_x.shape) for array in source))
        self.fixed = np.stack(
            [point_source(self.psf, self.grid, 0.62, 0.55).ravel(), np.ones(npix)]
            + [self.dense @ (self.light(0.002 * k) - self.light(0.0)) for k in (1, 2, 3)],
            axis=1,
        )
        self.sigma = np.array([np.inf, np.inf, 1.0, 1.0, 1.0])
        self.smooth = pixel_basis(self.sets, self.rays.source_x, self.rays.source_y)
        self.model = build_linear_model(
            self.smooth, self.fixed, self.convolution, self.weights, 1e-9, self.sigma
        )  # fmt: skip
        self.band = ScanBand(self.model, self.sets, self.rays, PERTURBER, self.convolution, self.weights)
        self.projection = project_band(self.band)

    def with_theta_e(self, theta_e):
        return dataclasses.replace(self.band, perturber=dataclasses.replace(PERTURBER, theta_e=theta_e))

    def build(self, positions, nested, theta_e=PERTURBER.theta_e):
        return build_shard(self.with_theta_e(theta_e), self.projection, positions, nested, response=True)

    def light(self, shift):
        """A source that the basis cannot follow."""
        x, y = self.rays.source_x + shift * np.cos(5.0 * self.rays.theta_y), self.rays.source_y
        u = np.hypot(x - 0.05, y + 0.04)
        return (3.0 * np.exp(-u / 0.08) + np.exp(-0.5 * ((u - 0.15) / 0.03) ** 2)).mean(axis=1)

    def bent(self, center, theta_e):
        if theta_e == 0.0:
            return self.rays.source_x, self.rays.source_y
        alpha = dataclasses.replace(PERTURBER, theta_e=abs(theta_e)).deflection(
            self.rays.theta_x - center[0], self.rays.theta_y - center[1]
        )
        return self.rays.source_x - np.sign(theta_e) * alpha[0], self.rays.source_y - np.sign(theta_e) * alpha[1]

    def noise(self, n, seed=5):
        draws = np.random.default_rng(seed).normal(size=(self.weights.size, n))
        return draws / np.maximum(self.weights, 1.0).ravel()[:, None] * (self.weights.ravel() > 0)[:, None]

    def fit(self, images):
        fit = solve(self.model, self.weights.reshape(-1, 1) * images)
        coefficients = physical_coefficients(self.model, fit.coefficients)[: self.model.n_source]
        return coefficients, residual_images(fit, self.convolution, self.weights)

    def response(self, shard, images):
        return delta_r_and_response(shard, self.band, *self.fit(images))[1]

    def columns(self, center, theta_e, point):
        """Whitened columns and square roots of their priors; None leaves the nested shapelets out."""
        source = self.bent(center, theta_e)
        parts = [self.dense @ pixel_basis(self.sets, *source), self.fixed]
        root = np.sqrt(self.model.prior) * self.model.column_norms
        if point is not None:
            item = (ShapeletSet(NESTED.n_max, point[2], point[0], point[1]),)
            parts.append(self.dense @ pixel_basis(item, *source))
            smooth = self.dense @ pixel_basis(item, self.rays.source_x, self.rays.source_y)
            seen = np.linalg.norm(self.weights.reshape(-1, 1) * smooth, axis=0)
            root = np.append(root, np.full(seen.size, np.sqrt(NESTED.ridge) * seen.max()))
        return self.weights.reshape(-1, 1) * np.hstack(parts), root

    def solve_directly(self, columns, root, data):
        """Coefficients and minima J of whitened data [npix, k]."""
        norms = np.linalg.norm(columns, axis=0)
        q, r = linalg.qr(np.vstack([columns / norms, np.diag(root / norms)]), mode="economic")
        target = np.vstack([data, np.zeros((norms.size, data.shape[1]))])
        projected = q.T @ target
        residual = target - q @ projected
        return linalg.solve_triangular(r, projected) / norms[:, None], np.sum(residual**2, axis=0)


@pytest.fixture(scope="module")
def scene():
    return Scene()


def images_of(scene):
    lensed = np.stack([scene.dense @ scene.light(shift) for shift in (0.0, 0.01)], axis=1)
    return lensed + scene.fixed[:, :2] @ [[20.0, 21.0], [0.01, 0.02]] + scene.noise(2)


@pytest.mark.parametrize("nested", [None, NESTED], ids=["", "nested"])
@pytest.mark.parametrize("band", [0, 1])
def test_score_and_fisher_are_those_of_direct_solves(band, nested):
    """s = -1/2 dJ/d eps by central differences of QR solves; F = what QR leaves of the image's derivative."""
    scene, step = Scene(band), 1e-3
    images = images_of(scene)
    shard = scene.build(POSITIONS, nested)
    found = scene.response(shard, images)
    data = scene.weights.reshape(-1, 1) * images
    scores, fishers = np.zeros_like(found.score), np.zeros_like(found.fisher)
    for i, center in enumerate(POSITIONS[:MASKED]):
        point = None if nested is None else shard.points[i]
        plain = scene.columns(center, 0.0, point)
        plus, minus = (scene.columns(center, sign * step * PERTURBER.theta_e, point) for sign in (1, -1))
        scores[i] = (scene.solve_directly(*minus, data)[1] - scene.solve_directly(*plus, data)[1]) / (4.0 * step)
        x, _ = scene.solve_directly(*plain, data)
        slope = (plus[0] @ x - minus[0] @ x) / (2.0 * step)
        fishers[i] = scene.solve_directly(*plain, slope)[1]
    np.testing.assert_allclose(found.fisher, fishers, rtol=2e-6, atol=1e-7)
    np.testing.assert_allclose(found.score, scores, rtol=0, atol=3e-5 * np.sqrt(fishers).max())
    assert np.abs(scores[:4]).min(axis=1).max() > 10.0
    assert np.all(found.score[MASKED] == 0.0)
    assert np.all(found.fisher[MASKED] == 0.0)
    assert np.isnan(found.amplitude[MASKED]).all()


def truth(scene, center, theta_e, coefficients):
    return scene.dense @ (pixel_basis(scene.sets, *scene.bent(center, theta_e)) @ coefficients)


@pytest.fixture(scope="module")
def source(scene):
    """Coefficients of a source within the basis."""
    return scene.fit((scene.dense @ scene.light(0.0))[:, None])[0][:, 0]


@pytest.mark.parametrize("theta_e", [0.0, 0.001, 0.002, 0.003])
@pytest.mark.parametrize("nested", [None, NESTED], ids=["", "nested"])
def test_injected_perturbers_are_weighed_right(scene, source, theta_e, nested):
    """Over noise draws: unbiased, with the error that is said; the noise of the fitted source adds f to F."""
    n = 1500
    where = POSITIONS[:3]
    shard = scene.build(where, nested)
    eps = theta_e / PERTURBER.theta_e
    for i, center in enumerate(where):
        image = truth(scene, center, theta_e, source)[:, None]
        found = scene.response(shard, image + scene.noise(n, 10 + i))
        clean = scene.response(shard, image)
        found_eps, error = found.amplitude[i], found.error[i]
        # Of 3 mas the change of the image is linear to 4 per cent.
        assert found_eps.mean() == pytest.approx(eps, abs=4.0 * found_eps.std() / np.sqrt(n) + 0.04 * eps)
        assert ((found_eps - eps) / error).std() == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * n) + 0.02)
        assert found_eps.std() == pytest.approx(error.mean(), rel=4.0 / np.sqrt(2.0 * n) + 0.02)
        added = found.fisher[i] - clean.fisher[i, 0]
        assert added.mean() == pytest.approx(found.noise[i, 0], abs=4.0 * added.std() / np.sqrt(n))
        assert clean.fisher[i, 0] > 10.0  # an error of 3 mas or less


def test_amplitude_of_both_bands_is_their_weighted_mean(source, scene):
    """Score and Fisher information add: the combination has the smaller error and the same mean."""
    other = Scene(1)
    bands = [
        item.response(
            item.build(POSITIONS[:1], NESTED),
            truth(item, POSITIONS[0], 0.003, source)[:, None] + item.noise(800, 40 + k),
        )
        for k, item in enumerate((scene, other))
    ]
    both = LinearResponse(*(sum(getattr(b, name) for b in bands) for name in ("score", "fisher", "noise")))
    for band in bands:
        assert np.all(both.fisher > band.fisher)
    pull = (both.amplitude - 0.3) / both.error
    assert abs(pull.mean()) < 4.0 / np.sqrt(800.0) + 0.04 * 0.3 / both.error.mean()
    assert pull.std() == pytest.approx(1.0, abs=4.0 / np.sqrt(1600.0))


@pytest.mark.parametrize("nested", [None, NESTED], ids=["", "nested"])
def test_expected_delta_r_is_that_of_images_with_the_perturber(scene, source, nested):
    """Against the scan with an operator of each theta_E, direct solves, and the mean over noise draws."""
    theta_e = [0.002, 0.01, 0.03]
    shard = scene.build(POSITIONS, nested)
    expected = expected_delta_r(shard, scene.band, theta_e, source)
    assert expected.shape == (3, len(POSITIONS))
    assert np.all(expected[:, MASKED] == 0.0)
    for row, value in enumerate(theta_e):
        own = scene.build(POSITIONS, nested, value)
        images = np.stack([truth(scene, center, value, source) for center in POSITIONS], axis=1)
        scan = delta_r(own, scene.with_theta_e(value), *scene.fit(images))
        np.testing.assert_allclose(np.diag(scan), expected[row], rtol=1e-3, atol=1e-3)
        for i, center in enumerate(POSITIONS[:3]):
            point = None if nested is None else shard.points[i]
            data = scene.weights.reshape(-1, 1) * images[:, i : i + 1]
            minima = [scene.solve_directly(*scene.columns(center, t, point), data)[1][0] for t in (0.0, value)]
            assert minima[1] - minima[0] == pytest.approx(expected[row, i], rel=1e-3, abs=1e-3)
    assert expected[1].min() < -50.0
    noisy = truth(scene, POSITIONS[0], 0.01, source)[:, None] + scene.noise(1000)
    scan = delta_r(shard, scene.band, *scene.fit(noisy))[0]
    assert scan.mean() == pytest.approx(expected[1, 0], abs=4.0 * scan.std() / np.sqrt(1000))
