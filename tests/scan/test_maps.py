"""Scan maps: batches, exact zeros, scaling, a mock with a clump."""

import numpy as np
import pytest

from warmlens.fitting.linear import physical_coefficients, solve
from warmlens.imaging.shapelets import pixel_basis
from warmlens.scan.maps import delta_r, residual_images


def test_residual_images_are_the_adjoint_of_the_whitened_psf(band, mocks):
    fit = solve(band.model, band.whiten(mocks[:3]))
    tau = residual_images(fit, band.convolution, band.weights)
    assert tau.shape == (band.weights.size, 3)
    image = np.random.default_rng(9).normal(size=band.grid.shape)
    for i in range(3):
        forward = band.weights * band.convolution.forward(image)
        assert tau[:, i] @ image.ravel() == pytest.approx(fit.residual[:, i] @ forward.ravel(), rel=1e-10)


@pytest.mark.parametrize("batch", [1, 3, 7, 16])
def test_a_mock_does_not_depend_on_its_batch(band, shard, mocks, batch):
    """To 1e-9 of the map's maximum, from image to map (matrix products round with the batch)."""
    whole = band.scan(shard, mocks)
    part = band.scan(shard, mocks[5 : 5 + batch])
    largest = np.abs(whole[:, 5 : 5 + batch]).max(axis=0)
    assert np.all(np.abs(part - whole[:, 5 : 5 + batch]).max(axis=0) < 1e-9 * largest)


def test_zero_exactly_where_nothing_unmasked_moves(band, shard, mocks):
    result = band.scan(shard, mocks)
    empty = np.diff(shard.pixel_offsets) == 0
    assert 0 < empty.sum() < empty.size
    np.testing.assert_array_equal(result[empty], 0.0)
    assert np.abs(result[~empty]).max(axis=1).min() > 0.0


def test_delta_r_is_quadratic_in_the_image(band, shard, mocks):
    """J is a quadratic form of the data, so is its change: parallelogram identity and scaling."""
    a, b = mocks[0], mocks[1]
    maps = band.scan(shard, np.stack([a, b, a + b, a - b, 3.0 * a]))
    scale = np.abs(maps).max()
    np.testing.assert_allclose(maps[:, 2] + maps[:, 3], 2.0 * (maps[:, 0] + maps[:, 1]), rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(maps[:, 4], 9.0 * maps[:, 0], rtol=0, atol=1e-9 * scale)


def test_a_clump_is_found_where_it_is(band, shard, raster, mocks):
    """Without noise the fit with the true perturber is perfect: Delta R there is -J_smooth, the minimum."""
    positions = raster.coordinates()
    position = int(np.argmin(np.abs(positions - (0.525, 0.075)).sum(axis=1)))
    alpha_x, alpha_y = band.perturber.deflection(
        band.rays.theta_x - positions[position, 0], band.rays.theta_y - positions[position, 1]
    )
    truth = np.random.default_rng(4).normal(size=band.model.n_source)
    columns = pixel_basis(band.sets, band.rays.source_x - alpha_x, band.rays.source_y - alpha_y)
    image = band.convolution.forward((columns @ truth).reshape(band.grid.shape))
    fit = solve(band.model, band.whiten(image))
    result = band.scan(shard, image[None])[:, 0]
    assert fit.chi2[0] > 10.0
    assert np.argmin(result) == position
    assert result[position] == pytest.approx(-fit.chi2[0], rel=1e-3)


def test_shapes_are_checked(band, shard, mocks):
    fit = solve(band.model, band.whiten(mocks[:2]))
    tau = residual_images(fit, band.convolution, band.weights)
    coefficients = physical_coefficients(band.model, fit.coefficients)
    with pytest.raises(ValueError, match="n_source = 24"):
        delta_r(shard, band.sets, band.rays, band.perturber, coefficients, tau)
    with pytest.raises(ValueError, match="tau"):
        delta_r(shard, band.sets, band.rays, band.perturber, coefficients[:24], tau[:, :1])
    with pytest.raises(ValueError, match="one image"):
        residual_images(fit, band.convolution, band.weights[:-1])
