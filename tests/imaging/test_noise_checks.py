from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from warmlens.imaging.noise_checks import measure_scatter, uninformative

SHAPE = (80, 90)
ALL = np.ones(SHAPE, dtype=bool)


def _sky(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """A galaxy on blank sky, noise of 0.01 and of the light."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    light = 2.0 * np.exp(-0.5 * ((x - 40.0) ** 2 + (y - 35.0) ** 2) / 8.0**2)
    sigma = np.sqrt(1e-4 + light / 2000.0)
    return light + sigma * np.random.default_rng(seed).standard_normal(SHAPE), sigma


def test_scatter_is_that_of_the_noise() -> None:
    scatters = [measure_scatter(*_sky(seed), ALL) for seed in range(10)]
    for name in ("sky", "sky_neighbours", "bright"):
        values = [getattr(scatter, name) for scatter in scatters]
        assert np.mean(values) == pytest.approx(1.0, abs=0.05), name
    image, sigma = _sky()
    for factor in (0.1, 3.0):
        scatter = measure_scatter(image, factor * sigma, ALL)
        assert scatter is not None
        assert scatter.sky == pytest.approx(1.0 / factor, rel=0.1)


def test_correlated_noise_lowers_the_scatter_of_neighbours_only() -> None:
    """Drizzled: variance as before, neighbours alike. Bright pixels are judged free of that."""
    image, sigma = _sky()
    clean = image - sigma * np.random.default_rng(1).standard_normal(SHAPE)
    noise = ndimage.uniform_filter(np.random.default_rng(2).standard_normal(SHAPE), 2) * 2.0
    scatter = measure_scatter(clean + sigma * noise, sigma, ALL)
    assert scatter is not None
    assert scatter.sky == pytest.approx(1.0, abs=0.1)
    assert scatter.sky_neighbours < 0.7
    assert scatter.bright == pytest.approx(1.0, abs=0.15)


def test_masked_and_empty_pixels_do_not_scatter() -> None:
    image, sigma = _sky()
    used = ALL.copy()
    used[:20] = False
    image[:20], sigma[:20] = 0.0, np.inf
    image[70:, 60:] = 0.0
    scatter = measure_scatter(image, sigma, used)
    assert scatter is not None
    assert scatter.sky == pytest.approx(1.0, abs=0.1)
    assert scatter.n_constant == 8 * 28
    assert measure_scatter(np.ones(SHAPE), sigma, ALL) is None
    assert measure_scatter(image, sigma, np.indices(SHAPE).sum(0) % 2 == 0) is None


def test_pixels_that_say_nothing() -> None:
    image, sigma = _sky()
    image[35, 40], sigma[35, 40] = 170.0, 10.0  # the core of a quasar, its PSF uncertain: it is measured
    for value, ignored in ((1e8, 5), (np.inf, 5), (2.0, 5), (0.5, 0), (0.05, 0)):
        changed = sigma.copy()
        changed[0, :5] = value
        pixels = uninformative(image, changed, ALL)
        assert np.count_nonzero(pixels.ignored) == ignored
        assert np.count_nonzero(pixels.ambiguous) == (5 if value == 0.5 else 0)
        assert not pixels.too_quiet.any()
    sigma[0, 0] = 1e-6
    assert np.count_nonzero(uninformative(image, sigma, ALL).too_quiet) == 1


def test_most_pixels_may_be_ignored() -> None:
    image, sigma = _sky()
    sigma[:, 10:] = 1e8
    pixels = uninformative(image, sigma, ALL)
    assert np.count_nonzero(pixels.ignored) == SHAPE[0] * 80
    assert pixels.quiet_sigma == pytest.approx(0.01, rel=0.05)
