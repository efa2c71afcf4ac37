"""Scan maps: batches, exact zeros, scaling, a mock with a clump."""

import dataclasses

import numpy as np
import pytest

from warmlens.fitting.linear import solve
from warmlens.imaging.shapelets import pixel_basis
from warmlens.scan.apply import delta_r
from warmlens.scan.maps import residual_images
from warmlens.scan.nested import NestedShapelets


def test_residual_images_are_the_adjoint_of_the_whitened_psf(band, mocks):
    fit = solve(band.model, band.whiten(mocks[:3]))
    back_projected = residual_images(fit, band.convolution, band.weights)
    assert back_projected.shape == (band.weights.size, 3)
    image = np.random.default_rng(9).normal(size=band.grid.shape)
    for i in range(3):
        forward = band.weights * band.convolution.forward(image)
        expected = fit.residual[:, i] @ forward.ravel()
        assert back_projected[:, i] @ image.ravel() == pytest.approx(expected, rel=1e-10)


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


def test_zero_exactly_with_nested_shapelets_too(band, nested_shard, mocks):
    result = band.scan(nested_shard, mocks[:3])
    empty = np.diff(nested_shard.pixel_offsets) == 0
    assert empty.any()
    np.testing.assert_array_equal(result[empty], 0.0)
    assert np.abs(result[~empty]).min() > 0.0
    maps = band.residual_maps(nested_shard, mocks[:3])
    np.testing.assert_array_equal(maps.r_sens[empty], 0.0)
    np.testing.assert_array_equal(maps.r_pert[empty], maps.r_smooth[empty])


def perturbed_image(band, center, truth):
    alpha_x, alpha_y = band.perturber.deflection(band.rays.theta_x - center[0], band.rays.theta_y - center[1])
    columns = pixel_basis(band.sets, band.rays.source_x - alpha_x, band.rays.source_y - alpha_y)
    return band.convolution.forward((columns @ truth).reshape(band.grid.shape))


def with_noise(band, image, n):
    noise = np.random.default_rng(12).normal(size=(n, *band.grid.shape))
    return image + noise * np.divide(1.0, band.weights, out=np.zeros_like(band.weights), where=band.weights > 0)


def test_perturber_is_found_and_delta_r_is_minus_r_sens(band, nested_shard, raster):
    """Nested shapelets included: without noise R_pert = 0, so that Delta R = -R_smooth = -R_sens; with noise
    Delta R = -R_sens to a few times the noise of the difference, of variance 4 |P_pert - P_smooth|^2."""
    positions = raster.coordinates()
    position = int(np.argmin(np.abs(positions - (0.525, 0.075)).sum(axis=1)))
    image = perturbed_image(band, positions[position], 3.0 * np.random.default_rng(4).normal(size=24))
    clean = band.residual_maps(nested_shard, image[None])
    delta = band.scan(nested_shard, image[None])[:, 0]
    assert np.argmin(delta) == position
    assert delta[position] < -100.0
    assert clean.r_pert[position, 0] < 1e-3 * clean.r_smooth[position, 0]
    assert clean.r_sens[position, 0] == pytest.approx(clean.r_smooth[position, 0], rel=0.01)
    assert delta[position] == pytest.approx(-clean.r_sens[position, 0], rel=0.01)

    images = with_noise(band, image, 60)
    delta, maps = band.scan(nested_shard, images), band.residual_maps(nested_shard, images)
    assert np.mean(np.argmin(delta, axis=0) == position) > 0.9
    difference = delta[position] + maps.r_sens[position]
    assert np.abs(difference).max() < 0.15 * maps.r_sens[position].min()
    assert abs(difference.mean()) < 5.0 * difference.std() / np.sqrt(60)


def test_null_mocks_scatter_as_the_projections_say(band, nested_shard, raster):
    """Smooth truth m and unit noise n, projections P_s, P_p of the two fits, F2 = |P_p - P_s|^2 (Frobenius), and
    b2 = |(1 - P_p) m|^2: Delta R = b2 + 2 m.(1 - P_p).n + n.(P_s - P_p).n has mean b2 and variance 4 b2 + 2 F2,
    R_sens has mean b2 + F2. So Delta R scatters about R_sens - F2 with variance near 4 R_sens (weak prior)."""
    truth = 2.0 * np.random.default_rng(8).normal(size=24)
    image = band.convolution.forward(
        (pixel_basis(band.sets, band.rays.source_x, band.rays.source_y) @ truth).reshape(band.grid.shape)
    )
    n = 3000
    images = with_noise(band, image, n)
    position = int(np.argmin(np.abs(raster.coordinates() - (0.525, 0.075)).sum(axis=1)))
    one = band.shard(raster.coordinates()[position : position + 1], NestedShapelets(5, 1e-5, (0.02, 0.1)))
    delta, maps = band.scan(one, images)[0], band.residual_maps(one, images)
    b2 = band.scan(one, image[None])[0, 0]
    assert b2 > 10.0
    noise = band.residual_maps(one, images - image)  # of the noise alone: mean of R_sens is F2
    f2 = noise.r_sens[0].mean()
    assert delta.mean() == pytest.approx(b2, abs=4.0 * np.sqrt((4.0 * b2 + 2.0 * f2) / n))
    assert delta.var() == pytest.approx(4.0 * b2 + 2.0 * f2, rel=4.0 * np.sqrt(2.0 / n))
    assert maps.r_sens[0].mean() == pytest.approx(b2 + f2, abs=4.0 * maps.r_sens[0].std() / np.sqrt(n))
    assert np.all(maps.r_sens >= 0.0)


def test_residual_maps_and_delta_r_differ_by_the_penalty(band, nested_shard, mocks):
    """J = R + penalty, and the priors are weak: R_pert - R_smooth is Delta R up to the change of the penalty."""
    delta, maps = band.scan(nested_shard, mocks), band.residual_maps(nested_shard, mocks)
    change = maps.r_pert - maps.r_smooth
    np.testing.assert_allclose(change, delta, rtol=0.05, atol=0.02 * np.abs(delta).max())


def test_sensitivity_must_have_been_read(band, shard, mocks):
    with pytest.raises(ValueError, match="sensitivity"):
        band.residual_maps(shard._replace(sensitivity=np.empty(0)), mocks[:1])


def test_shapes_are_checked(band, shard, mocks):
    fit = solve(band.model, band.whiten(mocks[:2]))
    coefficients, back_projected = band.fit(mocks[:2])
    with pytest.raises(ValueError, match="n_source = 24"):
        delta_r(shard, band, fit.coefficients, back_projected)
    with pytest.raises(ValueError, match=r"back_projected must be \[npix, k\]"):
        delta_r(shard, band, coefficients, back_projected[:, :1])
    with pytest.raises(ValueError, match="one image"):
        residual_images(fit, band.convolution, band.weights[:-1])
    with pytest.raises(ValueError, match="image is 32 x 30, but weights are"):
        dataclasses.replace(band, weights=band.weights[:-1])
