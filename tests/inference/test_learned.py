from __future__ import annotations

import numpy as np
import pytest

from warmlens.inference.learned import learned_summaries


def data(n=1500, p=60, noise=1.0, seed=1):
    rng = np.random.default_rng(seed)
    theta = rng.uniform(size=(n + 1, 2))
    x = 0.3 * theta[:, :1] * rng.standard_normal(p) + 0.1 * noise * rng.standard_normal((n + 1, p))
    return theta[1:], x[1:], x[0], theta[0]


def test_what_the_summaries_tell_is_learned_and_what_they_do_not_is_not():
    theta, x, observed, truth = data()
    learned = learned_summaries(theta, x, observed, np.random.default_rng(0))
    assert learned.r_squared[0] > 0.9
    assert abs(learned.r_squared[1]) < 0.05
    assert np.corrcoef(learned.samples[:, 0], theta[:, 0])[0, 1] > 0.95
    assert learned.observed[0] == pytest.approx(truth[0], abs=0.15)
    assert learned.penalty[1] > learned.penalty[0]


def test_several_observations_are_learned_at_once():
    theta, x, observed, _ = data(300)
    both = learned_summaries(theta, x, np.stack([x[7], observed]), np.random.default_rng(0))
    one = learned_summaries(theta, x, observed, np.random.default_rng(0))
    assert both.observed.shape == (2, 2)
    np.testing.assert_allclose(both.observed[1], one.observed, rtol=1e-12)
    np.testing.assert_array_equal(both.samples, one.samples)


def test_predictions_are_out_of_sample():
    """Pure noise with as many summaries as half the samples: a fit in sample would look good."""
    rng = np.random.default_rng(2)
    theta, x = rng.uniform(size=(200, 1)), rng.standard_normal((200, 100))
    learned = learned_summaries(theta, x, x[0], np.random.default_rng(0))
    assert learned.r_squared[0] < 0.05
    in_sample = x @ np.linalg.lstsq(x, theta[:, 0] - theta.mean(), rcond=None)[0]
    assert np.corrcoef(in_sample, theta[:, 0])[0, 1] > 0.5


def test_ridge_is_that_of_an_independent_code():
    linear_model = pytest.importorskip("sklearn.linear_model")
    theta, x, observed, _ = data(300, 10)
    learned = learned_summaries(theta, x, observed, np.random.default_rng(3))
    fold = np.random.default_rng(3).permutation(np.arange(300) % 10)
    z = np.arcsinh(x / np.sqrt((x**2).mean(axis=0)))
    z = (z - z.mean(axis=0)) / z.std(axis=0)
    for i in range(10):
        model = linear_model.Ridge(alpha=learned.penalty[0]).fit(z[fold != i], theta[fold != i, 0])
        expected = theta[:, 0].mean() + z[fold == i] @ model.coef_  # one intercept for all folds
        np.testing.assert_allclose(learned.samples[fold == i, 0], expected, rtol=1e-8)


def test_degenerate_tables():
    theta, x, observed, _ = data(60)
    constant = learned_summaries(theta, np.zeros_like(x), np.zeros_like(observed), np.random.default_rng(0))
    assert (np.ptp(constant.samples, axis=0) == 0.0).all()  # an intercept of each fold would tell the folds apart
    assert (constant.r_squared < 0.05).all()
    with pytest.raises(ValueError, match=r"need 50 samples, there are 20; raise campaign\.n_samples"):
        learned_summaries(theta[:20], x[:20], observed, np.random.default_rng(0))
