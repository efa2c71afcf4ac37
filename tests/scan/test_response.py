"""Linear response: batches, units, exact zeros, what the map is, sensitivity in mass."""

import dataclasses

import numpy as np
import pytest

from warmlens.imaging.shapelets import pixel_basis
from warmlens.scan.apply import delta_r_and_response
from warmlens.scan.perturber import Perturber, basis_change, basis_response, perturbed_basis
from warmlens.scan.response import (
    LinearResponse,
    detectable_theta_e,
    expected_delta_r,
    mass_within_truncation,
)


@pytest.fixture(scope="module")
def response_shard(band, raster, nested):
    return band.shard(raster.coordinates(), nested, response=True)


def linear_response(*arguments):
    return delta_r_and_response(*arguments)[1]


def respond(band, shard, images):
    return linear_response(shard, band, *band.fit(images))


def test_derivative_of_the_basis_is_that_of_small_perturbers(band, response_shard):
    """Against Richardson-extrapolated differences of `basis_change` at 1% and 0.5% of theta_e."""
    position = int(np.argmax(np.diff(response_shard.pixel_offsets)))
    moved = response_shard.pixels[slice(*response_shard.pixel_offsets[position : position + 2])]
    x, y = response_shard.positions[position]

    def change(scale):
        small = dataclasses.replace(band.perturber, theta_e=scale * band.perturber.theta_e)
        return basis_change(perturbed_basis(band.sets, band.rays, small), x, y, moved) / scale

    expected = 2.0 * change(0.005) - change(0.01)  # one-sided: the error of order scale cancels
    found = basis_response(band.basis(), x, y, moved)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4 * np.abs(expected).max())
    assert np.abs(found - change(0.01)).max() > 1e-4 * np.abs(expected).max()


def test_a_mock_does_not_depend_on_its_batch(band, response_shard, mocks):
    whole, part = respond(band, response_shard, mocks), respond(band, response_shard, mocks[3:8])
    for name in ("score", "fisher"):
        expected = getattr(whole, name)[:, 3:8]
        np.testing.assert_allclose(getattr(part, name), expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_zero_exactly_where_nothing_unmasked_moves(band, response_shard, mocks):
    found = respond(band, response_shard, mocks[:3])
    empty = np.diff(response_shard.pixel_offsets) == 0
    assert 0 < empty.sum() < empty.size
    for array in (found.score, found.fisher):
        np.testing.assert_array_equal(array[empty], 0.0)
        assert np.abs(array[~empty]).min() > 0.0
    assert np.isnan(found.amplitude[empty]).all()
    assert np.isfinite(found.significance[~empty]).all()


def test_score_and_fisher_scale_with_image_and_perturber(band, raster, nested, response_shard, mocks):
    """Both are quadratic in the image; the unit of eps is theta_e, the deflection eps theta_e is the same."""
    once, thrice = respond(band, response_shard, mocks[:2]), respond(band, response_shard, 3.0 * mocks[:2])
    np.testing.assert_allclose(thrice.score, 9.0 * once.score, rtol=0, atol=1e-8 * np.abs(once.score).max())
    np.testing.assert_allclose(thrice.fisher, 9.0 * once.fisher, rtol=1e-6)
    perturber = Perturber(2.0 * band.perturber.theta_e, band.perturber.r_trunc)
    double = dataclasses.replace(band, perturber=perturber)
    other = respond(double, double.shard(raster.coordinates(), nested, response=True), mocks[:2])
    np.testing.assert_allclose(other.fisher, 4.0 * once.fisher, rtol=1e-6)
    np.testing.assert_allclose(other.noise, 4.0 * once.noise, rtol=1e-6, atol=1e-9 * once.noise.max())
    np.testing.assert_allclose(other.significance, once.significance, rtol=1e-6)


def test_noise_alone_has_scores_of_variance_fisher(band, response_shard):
    """Smooth truth and unit noise: over 800 draws the mean of s^2 / F is 1, that of F the truth's plus f.

    Where the source is faint and the prior of the nested shapelets binds, the score scatters less.
    """
    rng = np.random.default_rng(6)
    inverse = np.divide(1.0, band.weights, out=np.zeros_like(band.weights), where=band.weights > 0.0)
    image = (band.model.design @ rng.normal(0.0, 30.0, band.model.design.shape[1])).reshape(band.grid.shape)
    images = (image + rng.normal(size=(800, *band.grid.shape))) * inverse
    found, clean = respond(band, response_shard, images), respond(band, response_shard, (image * inverse)[None])
    known = found.fisher.mean(axis=1) > 0.0
    mean = np.mean(found.significance[known] ** 2, axis=1)
    allowed = 5.0 * np.sqrt(2.0 / 800)
    assert mean.max() < 1.0 + allowed
    assert mean.min() > 0.5
    bright = clean.fisher[known, 0] > 0.01 * clean.fisher.max()
    assert bright.sum() > 40
    assert np.abs(mean[bright] - 1.0).max() < allowed
    assert np.mean(mean[bright]) == pytest.approx(1.0, abs=0.03)
    alone = respond(band, response_shard, images - image * inverse)  # noise makes all of F, known to 3%
    error = alone.fisher.std(axis=1) / np.sqrt(800)
    assert np.all(np.abs(alone.fisher.mean(axis=1) - alone.noise[:, 0])[known] < 5.0 * error[known])
    assert np.median(error[known] / alone.noise[known, 0]) < 0.04


def test_fisher_is_what_the_linear_columns_leave(band, raster):
    """Without nested shapelets: F = |(1 - P) g|^2 of the image's derivative g, P by a QR of the design."""
    positions = raster.coordinates()[np.argmin(np.abs(raster.coordinates() - (0.525, 0.075)).sum(axis=1))][None]
    x = np.random.default_rng(4).normal(size=(band.model.n_source, 1))
    shard = band.shard(positions, response=True)
    found = linear_response(shard, band, x, np.zeros((band.weights.size, 1)))
    alpha = band.perturber.deflection(band.rays.theta_x - positions[0, 0], band.rays.theta_y - positions[0, 1])
    step = 1e-3
    plus, minus = (
        pixel_basis(band.sets, band.rays.source_x - s * step * alpha[0], band.rays.source_y - s * step * alpha[1])
        for s in (1.0, -1.0)
    )
    slope = band.convolution.forward(((plus - minus) @ x).reshape(band.grid.shape)) / (2.0 * step)
    g = (band.weights * slope).ravel()
    q, _ = np.linalg.qr(band.model.design)
    left = g - q @ (q.T @ g)
    assert found.fisher[0, 0] == pytest.approx(left @ left, rel=1e-5)
    assert found.fisher[0, 0] < 0.9 * (g @ g)


def test_response_must_have_been_built(band, nested_shard, mocks):
    with pytest.raises(ValueError, match="no linear response"):
        respond(band, nested_shard, mocks[:1])
    coefficients, _ = band.fit(mocks[:1])
    with pytest.raises(ValueError, match="no linear response"):
        expected_delta_r(nested_shard, band, [0.01], coefficients[:, 0])


def test_shapes_are_checked(band, response_shard, mocks):
    coefficients, back_projected = band.fit(mocks[:2])
    with pytest.raises(ValueError, match="n_source = 24"):
        linear_response(response_shard, band, coefficients[:5], back_projected)
    with pytest.raises(ValueError, match="back_projected"):
        linear_response(response_shard, band, coefficients, back_projected[:, :1])


def test_delta_r_is_the_same_with_the_response(band, response_shard, mocks):
    both, _ = delta_r_and_response(response_shard, band, *band.fit(mocks))
    np.testing.assert_array_equal(both, band.scan(response_shard, mocks))


def test_slope_is_that_of_the_basis(band, response_shard, mocks):
    """Without nested shapelets in K and R: F = delta'.K delta' with dB' of the operator's central difference."""
    coefficients, back_projected = band.fit(mocks[:2])
    shard = band.shard(response_shard.positions, response=True)
    found = linear_response(shard, band, coefficients, back_projected)
    basis = band.basis()
    for position in np.flatnonzero(np.diff(shard.pixel_offsets))[::7]:
        moved = shard.pixels[slice(*shard.pixel_offsets[position : position + 2])]
        slope = basis_response(basis, *shard.positions[position], moved).T @ coefficients
        scale = np.abs(slope).max() * np.abs(back_projected[moved]).max() * moved.size
        expected = np.sum(slope * back_projected[moved], axis=0)
        np.testing.assert_allclose(found.score[position], expected, atol=1e-7 * scale)


def test_response_changes_nothing_else(nested_shard, response_shard):
    for name in ("matrices", "sensitivity", "nested_inverse", "points", "pixels"):
        np.testing.assert_array_equal(getattr(response_shard, name), getattr(nested_shard, name))
    m = np.diff(response_shard.pixel_offsets)
    assert response_shard.responses.size == np.sum(m * (m + 1) // 2 + 42 * m)
    assert nested_shard.responses.size == 0


def test_expected_delta_r_is_quadratic_for_small_deflections_only(band, response_shard, mocks):
    """eps^2 F to linear order; at 50 mas the source's structure does not let it go on so."""
    coefficients, _ = band.fit(mocks[:1])
    expected = expected_delta_r(response_shard, band, [1e-4, 0.05], coefficients[:, 0])
    zero = np.zeros((band.weights.size, 1))
    linear = linear_response(response_shard, band, coefficients, zero)
    bright = linear.fisher[:, 0] > 0.01 * linear.fisher.max()
    fisher = linear.fisher[bright, 0]
    # no residual leaves no nested shapelet in the fit: delta' is that of the source alone, as in the expectation
    np.testing.assert_allclose(-expected[0, bright], (1e-4 / 0.01) ** 2 * fisher, rtol=0.02)
    assert np.median(np.abs(-expected[1, bright] / (25.0 * fisher) - 1.0)) > 0.1
    assert np.all(expected <= 0.0)


def test_detectable_theta_e_between_below_and_beyond_the_list():
    theta_e = np.array([0.001, 0.01, 0.1])
    gain = np.array([[0.1, 100.0, 0.0], [10.0, 1e4, 0.0], [1e3, 1e6, 9.0]])  # [theta_e, position]
    found = detectable_theta_e(theta_e, -gain, 40.0)
    assert found[0] == pytest.approx(0.02)  # between the second and the third
    assert found[1] == pytest.approx(0.001 * np.sqrt(0.4))  # below the first
    assert np.isnan(found[2])
    steep = detectable_theta_e(theta_e, -np.array([[1e-3], [1.0], [1e6]]), 1e3)
    assert steep[0] == pytest.approx(np.sqrt(0.01 * 0.1))


def test_mass_of_the_paper_s_perturber():
    """Birrer+2017: 0.01" and 0.1" are 10^8.35 Msun for RXJ1131-1231."""
    from warmlens.cosmology import Cosmology, LensGeometry

    lens = LensGeometry.from_redshifts(Cosmology(), 0.295, 0.658)
    mass = mass_within_truncation(np.array(0.01), 0.1, lens.sigma_crit_msun_arcsec2)
    assert np.log10(mass) == pytest.approx(8.35, abs=0.005)


def test_bands_add():
    a, b = ([np.array([value]) for value in values] for values in ((2.0, 5.0, 1.0), (9.0, 9.0, 0.0)))
    both = LinearResponse(*(x + y for x, y in zip(a, b, strict=True)))
    assert both.amplitude[0] == pytest.approx(
        (4.0 * 0.5 + 9.0 * 1.0) / 13.0
    )  # mean of s / (F - f), weighted by F - f
    assert both.error[0] == pytest.approx(np.sqrt(14.0) / 13.0)
    assert both.significance[0] == pytest.approx(11.0 / np.sqrt(14.0))
    lost = LinearResponse(np.array([1.0]), np.array([2.0]), np.array([3.0]))
    assert np.isnan(lost.amplitude[0])
    assert lost.significance[0] == pytest.approx(1.0 / np.sqrt(2.0))
