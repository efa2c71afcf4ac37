"""Linear model of a band: normal equations, recovered truth, statistics, refusals."""

import numpy as np
import pytest

from warmlens.fitting.linear import build_linear_model, physical_coefficients, solve
from warmlens.imaging.psf import Convolution, hst_like_psf

SHAPE = (24, 20)
RIDGE = 1e-8


@pytest.fixture(scope="module")
def parts():
    rng = np.random.default_rng(21)
    source = rng.normal(size=(480, 12)) * np.geomspace(1e-2, 1e2, 12)
    fixed = rng.normal(size=(480, 3))
    weights = rng.uniform(0.5, 2.0, SHAPE)
    weights[5:9, 3:12] = 0.0
    return source, fixed, Convolution(hst_like_psf(814.0, 0.05, 9), SHAPE), weights


@pytest.fixture(scope="module")
def model(parts):
    return build_linear_model(*parts, RIDGE)


def images_of(parts, coefficients):
    source, fixed, convolution, _ = parts
    light = convolution.forward((source @ coefficients[:12]).reshape(SHAPE)).ravel()
    return light + fixed @ coefficients[12:]


def test_scaling_and_factor(model):
    assert model.n_source == 12
    np.testing.assert_allclose(np.linalg.norm(model.design, axis=0), 1.0, rtol=1e-13)
    gram = model.design.T @ model.design + RIDGE * np.eye(15)
    np.testing.assert_allclose(model.inverse_factor @ gram @ model.inverse_factor.T, np.eye(15), atol=1e-10)
    np.testing.assert_array_equal(np.triu(model.inverse_factor, 1), 0.0)


def test_masked_pixels_do_not_enter(parts, model):
    masked = parts[3].ravel() == 0.0
    np.testing.assert_array_equal(model.design[masked], 0.0)


def test_truth_is_recovered_without_noise(parts, model):
    truth = np.random.default_rng(5).normal(size=15)
    fit = solve(model, (images_of(parts, truth) * parts[3].ravel())[:, None])
    np.testing.assert_allclose(physical_coefficients(model, fit.coefficients)[:, 0], truth, rtol=1e-5, atol=1e-6)
    assert fit.chi2[0] < 1e-8


def test_solution_minimises_the_objective(parts, model):
    """Against numpy's least squares on the stacked system [A; sqrt(ridge)], and its J is chi2 + penalty."""
    whitened = np.random.default_rng(6).normal(size=(480, 4)) * (parts[3].ravel()[:, None] > 0)
    fit = solve(model, whitened)
    stacked = np.vstack([model.design, np.sqrt(RIDGE) * np.eye(15)])
    target = np.vstack([whitened, np.zeros((15, 4))])
    expected = np.linalg.lstsq(stacked, target)[0]
    np.testing.assert_allclose(fit.coefficients, expected, rtol=0, atol=1e-10)
    objective = np.sum((target - stacked @ expected) ** 2, axis=0)
    np.testing.assert_allclose(fit.chi2 + fit.penalty, objective, rtol=1e-12)
    np.testing.assert_allclose(fit.residual, whitened - model.design @ expected, atol=1e-10)


def test_prior_of_single_columns(parts):
    """A Gaussian prior on an amplitude is one more datum, amplitude / sigma = 0 +- 1; elsewhere the ridge."""
    source, fixed, convolution, weights = parts
    sigma = np.array([np.inf, 3e-3, 0.2])
    model = build_linear_model(*parts, RIDGE, sigma)
    np.testing.assert_array_equal(model.prior[:13], RIDGE)
    expected = RIDGE + (sigma[1:] * model.column_norms[13:]) ** -2.0
    np.testing.assert_allclose(model.prior[13:], expected, rtol=1e-13)
    gram = model.design.T @ model.design + np.diag(model.prior)
    np.testing.assert_allclose(model.inverse_factor @ gram @ model.inverse_factor.T, np.eye(15), atol=1e-10)

    whitened = np.random.default_rng(16).normal(size=(480, 4)) * (weights.ravel()[:, None] > 0)
    fit = solve(model, whitened)
    columns = np.hstack([convolution.forward(source.T.reshape(-1, *SHAPE)).reshape(12, -1).T, fixed])
    rows = np.diag(np.sqrt(model.prior) * model.column_norms)
    stacked = np.vstack([weights.reshape(-1, 1) * columns, rows])
    target = np.vstack([whitened, np.zeros((15, 4))])
    expected = np.linalg.lstsq(stacked / model.column_norms, target)[0] / model.column_norms[:, None]
    np.testing.assert_allclose(physical_coefficients(model, fit.coefficients), expected, rtol=1e-6, atol=1e-9)
    objective = np.sum((target - stacked @ expected) ** 2, axis=0)
    np.testing.assert_allclose(fit.chi2 + fit.penalty, objective, rtol=1e-12)
    free = solve(build_linear_model(*parts, RIDGE), whitened)
    assert np.all(np.abs(fit.coefficients[13]) < 0.1 * np.abs(free.coefficients[13]))


def test_infinite_prior_width_is_the_ridge(parts, model):
    same = build_linear_model(*parts, RIDGE, np.full(3, np.inf))
    np.testing.assert_array_equal(same.prior, model.prior)
    np.testing.assert_array_equal(same.inverse_factor, model.inverse_factor)


@pytest.mark.parametrize("sigma", [[1.0, 1.0], [1.0, 0.0, 1.0], [1.0, np.nan, 1.0]])
def test_impossible_prior_width_is_refused(parts, sigma):
    with pytest.raises(ValueError, match="fixed_sigma"):
        build_linear_model(*parts, RIDGE, np.array(sigma))


def test_noise_leaves_as_much_chi2_as_degrees_of_freedom(parts, model):
    unmasked = parts[3].ravel() > 0.0
    noise = np.random.default_rng(7).normal(size=(480, 400)) * unmasked[:, None]
    freedom = unmasked.sum() - 15
    assert solve(model, noise).chi2.mean() == pytest.approx(freedom, abs=4.0 * np.sqrt(2.0 * freedom / 400))


def test_a_fit_does_not_depend_on_its_batch(parts, model):
    whitened = np.random.default_rng(8).normal(size=(480, 37))
    together = solve(model, whitened)
    for i in (0, 17, 36):
        alone = solve(model, whitened[:, i : i + 1])
        np.testing.assert_allclose(alone.coefficients[:, 0], together.coefficients[:, i], rtol=0, atol=1e-11)
        assert alone.chi2[0] == pytest.approx(together.chi2[i], rel=1e-12)


def test_no_fixed_columns(parts):
    source, _, convolution, weights = parts
    assert build_linear_model(source, np.empty((480, 0)), convolution, weights, RIDGE).design.shape == (
        480,
        12,
    )


def test_empty_column_is_named(parts):
    source, fixed, convolution, weights = parts
    dark = source.copy()
    dark[:, 4] = 0.0
    with pytest.raises(ValueError, match=r"source column 4.*source\.n_max or smooth_model\.source\.beta_arcsec"):
        build_linear_model(dark, fixed, convolution, weights, RIDGE)
    only_masked = fixed.copy()
    only_masked[weights.ravel() > 0.0, 1] = 0.0
    with pytest.raises(ValueError, match="fixed column 1"):
        build_linear_model(source, only_masked, convolution, weights, RIDGE)


def test_non_finite_column_is_named(parts):
    source, fixed, convolution, weights = parts
    broken = fixed.copy()
    broken[100, 2] = np.nan
    with pytest.raises(ValueError, match=r"not finite.*fixed column 2"):
        build_linear_model(source, broken, convolution, weights, RIDGE)


def test_degenerate_columns_ask_for_a_larger_ridge(parts):
    source, fixed, convolution, weights = parts
    twins = np.hstack([fixed, fixed[:, :1]])
    with pytest.raises(ValueError, match=r"degenerate.*smooth_model\.ridge.*raise it"):
        build_linear_model(source, twins, convolution, weights, 1e-18)
    assert build_linear_model(source, twins, convolution, weights, RIDGE).design.shape[1] == 16


@pytest.mark.parametrize("ridge", [0.0, -1e-8, np.nan])
def test_impossible_ridge_is_refused(parts, ridge):
    with pytest.raises(ValueError, match=r"smooth_model\.ridge"):
        build_linear_model(*parts, ridge)


def test_weights_and_shapes_are_checked(parts):
    source, fixed, convolution, weights = parts
    with pytest.raises(ValueError, match="weights"):
        build_linear_model(source, fixed, convolution, -weights, RIDGE)
    with pytest.raises(ValueError, match="24 x 20"):
        build_linear_model(source[:-1], fixed, convolution, weights, RIDGE)
