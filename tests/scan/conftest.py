"""A small band to scan: 32 x 30 pixels, an arc, a mask, a PSF larger than half the image."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pytest

from warmlens.fitting.linear import build_linear_model, physical_coefficients, solve
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import Convolution, hst_like_psf, point_source
from warmlens.imaging.shapelets import ShapeletSet, pixel_basis
from warmlens.lensing.rays import SmoothRays
from warmlens.scan.apply import delta_r
from warmlens.scan.maps import residual_images, residual_maps
from warmlens.scan.nested import NestedShapelets
from warmlens.scan.operator import build_shard, project_band
from warmlens.scan.perturber import Perturber
from warmlens.scan.raster import Raster
from warmlens.scan.shard import ScanBand


@dataclass(frozen=True)
class Band(ScanBand):
    """A band to scan, with its pixel grid."""

    grid: PixelGrid

    @cached_property
    def projection(self):
        return project_band(self)

    def shard(self, positions, nested=None, **options):
        return build_shard(self, self.projection, positions, nested, **options)

    def whiten(self, images):
        return (self.weights * images).reshape(-1, self.weights.size).T

    def fit(self, images):
        """Source coefficients and back-projected residuals of the smooth fits."""
        fit = solve(self.model, self.whiten(images))
        coefficients = physical_coefficients(self.model, fit.coefficients)[: self.model.n_source]
        return coefficients, residual_images(fit, self.convolution, self.weights)

    def scan(self, shard, images):
        return delta_r(shard, self, *self.fit(images))

    def residual_maps(self, shard, images):
        return residual_maps(shard, self, solve(self.model, self.whiten(images)))


@pytest.fixture(scope="session")
def band():
    grid = PixelGrid.centred((32, 30), 0.05)
    theta_x, theta_y = grid.subpixel_coordinates(2)
    radius = np.hypot(theta_x, theta_y)
    rays = SmoothRays(theta_x, theta_y, theta_x * (1.0 - 0.5 / radius), theta_y * (1.0 - 0.5 / radius))
    sets = (ShapeletSet(5, 0.12, 0.06, 0.03), ShapeletSet(1, 0.04, -0.1, 0.05))
    psf = hst_like_psf(814.0, 0.05, 41)
    convolution = Convolution(psf, grid.shape)
    weights = np.random.default_rng(0).uniform(60.0, 100.0, grid.shape)
    weights[20:32, 0:14] = 0.0
    fixed = np.stack([point_source(psf, grid, 0.5, 0.1).ravel(), np.ones(grid.ny * grid.nx)], axis=1)
    model = build_linear_model(pixel_basis(sets, rays.source_x, rays.source_y), fixed, convolution, weights, 1e-8)
    return Band(model, sets, rays, Perturber(0.01, 0.1), convolution, weights, grid)


@pytest.fixture(scope="session")
def raster():
    return Raster(1.8, 1.8, 0.15)


@pytest.fixture(scope="session")
def shard(band, raster):
    return band.shard(raster.coordinates())


@pytest.fixture(scope="session")
def nested():
    return NestedShapelets(5, 1e-5, (0.02, 0.1))


@pytest.fixture(scope="session")
def nested_shard(band, raster, nested):
    return band.shard(raster.coordinates(), nested)


@pytest.fixture(scope="session")
def mocks(band):
    """40 images: a bright source, noise, and structure that the source basis cannot follow."""
    rng = np.random.default_rng(1)
    truth = rng.normal(size=(band.model.design.shape[1], 40)) * 30.0
    wiggles = band.convolution.forward(rng.normal(0.0, 0.02, (40, *band.grid.shape)))
    design_images = (band.model.design @ truth).T.reshape(40, *band.grid.shape)
    noise = rng.normal(size=(40, *band.grid.shape))
    inverse = np.divide(1.0, band.weights, out=np.zeros_like(band.weights), where=band.weights > 0.0)
    return (design_images + noise) * inverse + wiggles
