from __future__ import annotations

import numpy as np
import pytest

from warmlens.imaging.noise import NoiseModel

MODEL = NoiseModel(background_rms=0.01, exposure_s=1000.0)


def test_sigma() -> None:
    sigma = MODEL.sigma(np.array([-0.5, 0.0, 4.0]))
    np.testing.assert_allclose(sigma, [0.01, 0.01, np.hypot(0.01, np.sqrt(4.0 / 1000.0))])


def test_drawn_noise_has_the_mean_and_variance() -> None:
    rng = np.random.default_rng(2)
    for level in (-0.02, 0.0, 0.05, 3.0):
        image = np.full(200_000, level)
        drawn = MODEL.draw(image, image, rng)
        sigma = float(MODEL.sigma(np.array(level)))
        assert drawn.mean() == pytest.approx(level, abs=5.0 * sigma / np.sqrt(image.size))
        assert drawn.std() == pytest.approx(sigma, rel=0.01)
    assert abs(drawn.std() / 0.01 - 1.0) > 1.0  # the Poisson part is there


def test_noise_of_a_map() -> None:
    rng = np.random.default_rng(3)
    sigma = np.repeat([0.1, 2.0, np.inf], 50_000)
    drawn = NoiseModel(None, None).draw(np.ones(150_000), sigma, rng).reshape(3, -1)
    np.testing.assert_allclose(drawn.std(axis=1), [0.1, 2.0, 0.0], rtol=0.02)
    with pytest.raises(ValueError, match="a noise map was given"):
        NoiseModel(None, None).sigma(sigma)


def test_moments_of_a_mock_s_noise() -> None:
    """Mean, variance and skewness of Poisson counts and Gaussian background, and no correlation of pixels."""
    rng = np.random.default_rng(5)
    model = NoiseModel(background_rms=0.004, exposure_s=2000.0)
    level = 0.02  # 40 counts
    drawn = model.draw(np.full((1000, 1000), level), np.ones((1000, 1000)), rng) - level
    variance = 0.004**2 + level / 2000.0
    n = drawn.size
    assert abs(drawn.mean()) < 5.0 * np.sqrt(variance / n)
    assert drawn.var() == pytest.approx(variance, rel=5.0 * np.sqrt(2.0 / n) * 1.1)
    # third moment of the Poisson part alone: counts / exposure^3
    assert (drawn**3).mean() == pytest.approx(level / 2000.0**2, abs=4.0 * np.sqrt(15.0 * variance**3 / n))
    assert level / 2000.0**2 > 9.0 * np.sqrt(15.0 * variance**3 / n)  # a Gaussian would be seen
    for neighbour in (drawn[:, 1:] * drawn[:, :-1], drawn[1:] * drawn[:-1]):
        assert abs(neighbour.mean()) < 5.0 * variance / np.sqrt(neighbour.size)
    again = model.draw(np.full((1000, 1000), level), np.ones((1000, 1000)), np.random.default_rng(5)) - level
    assert np.array_equal(drawn, again)
