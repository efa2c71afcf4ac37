"""Correlated noise against noise that is filtered on the image itself, as drizzling does."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage, signal

from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.noise_correlation import (
    autocorrelation,
    checked_correlation,
    correlate,
    neighbours,
    sky_noise,
)
from warmlens.types import BoolArray, FloatArray

SHAPE = (120, 150)
KERNEL = np.array([[0.1, 0.5, 0.1], [0.3, 1.0, 0.3], [0.1, 0.5, 0.1]])
KERNEL /= np.sqrt(np.sum(KERNEL**2))  # filtered noise keeps its variance
EXPECTED = signal.correlate2d(KERNEL, KERNEL)  # [5, 5]


def filtered(rng: np.random.Generator, shape: tuple[int, int] = SHAPE) -> FloatArray:
    return ndimage.convolve(rng.standard_normal(shape), KERNEL, mode="wrap")


def around(radius: float) -> BoolArray:
    """Pixels farther than a radius from one off the middle."""
    y, x = np.indices(SHAPE)
    return np.hypot(x - 80, y - 55) > radius


def test_autocorrelation_is_the_mean_over_pairs() -> None:
    """Offset by offset, of pixels that are used, by brute force."""
    rng = np.random.default_rng(1)
    image, used = filtered(rng, (9, 12)), rng.random((9, 12)) < 0.7
    correlation = autocorrelation(image, used, 2)
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            pairs = [
                image[y, x] * image[y + dy, x + dx]
                for y, x in np.argwhere(used)
                if 0 <= y + dy < 9 and 0 <= x + dx < 12 and used[y + dy, x + dx]
            ]
            assert correlation[dy + 2, dx + 2] == pytest.approx(
                np.mean(pairs) / np.mean(image[used] ** 2), rel=1e-10
            )


def test_autocorrelation_needs_pairs() -> None:
    lonely = np.zeros((6, 6), dtype=bool)
    lonely[0, 0] = True
    with pytest.raises(ValueError, match="no two of 1 pixels are 2 apart"):
        autocorrelation(np.ones((6, 6)), lonely)
    with pytest.raises(ValueError, match="no pairs 2 pixels apart"):
        autocorrelation(np.ones((2, 6)), np.ones((2, 6), dtype=bool))


def test_drawn_noise_has_variance_and_correlation() -> None:
    rng = np.random.default_rng(2)
    everywhere = np.ones(SHAPE, dtype=bool)
    drawn = np.array([correlate(rng.standard_normal(SHAPE), EXPECTED) for _ in range(40)])
    correlation = np.mean([autocorrelation(one, everywhere) for one in drawn], axis=0)
    np.testing.assert_allclose(correlation, EXPECTED, atol=5.0 * 1.5 / np.sqrt(drawn.size))
    assert drawn.var() == pytest.approx(1.0, abs=0.01)
    # and so have means over boxes, where noise and substructure are compared
    boxes = drawn.reshape(40, 20, 6, 25, 6).mean(axis=(2, 4))
    reference = np.array([filtered(rng).reshape(20, 6, 25, 6).mean(axis=(1, 3)) for _ in range(40)])
    assert boxes.var() == pytest.approx(reference.var(), rel=0.03)
    assert boxes.var() > 3.0 / 36.0  # independent pixels: 1 / 36


def test_no_correlation_changes_nothing() -> None:
    white = np.random.default_rng(3).standard_normal((32, 40))
    alone = np.zeros((3, 3))
    alone[1, 1] = 1.0
    np.testing.assert_allclose(correlate(white, alone), white, atol=1e-12)


@pytest.mark.parametrize("sky_level", [0.0, 40.0], ids=["flat", "with a gradient"])
def test_sky_is_measured_without_bias(sky_level: float) -> None:
    """Over 60 images: less than a quarter of the scatter of one, where the background takes 0.1 of the sum."""
    rng = np.random.default_rng(4)
    sky = around(60.0)
    y, x = np.indices(SHAPE) / 100.0
    background = sky_level * (1.0 + x - 0.5 * y**2 + 0.3 * x**3 - 0.2 * x * y**3)
    measured, rms = zip(*(sky_noise(background + 0.2 * filtered(rng), sky) for _ in range(60)), strict=True)
    one = np.std(measured, axis=0).max()
    assert 0.02 < one < 0.06
    np.testing.assert_allclose(np.mean(measured, axis=0), EXPECTED, atol=0.25 * one + 4.0 * one / np.sqrt(60.0))
    sums = np.sum(measured, axis=(1, 2))
    assert np.mean(sums) == pytest.approx(EXPECTED.sum(), abs=0.5 * np.std(sums))
    assert np.mean(rms) == pytest.approx(0.2, rel=0.01)


def test_sources_in_the_sky_are_left_out() -> None:
    rng = np.random.default_rng(5)
    image = filtered(rng)
    clean, clean_rms = sky_noise(image, around(60.0))
    image[3:6, 2:5] += 50.0
    correlation, rms = sky_noise(image, around(60.0))
    np.testing.assert_allclose(correlation, clean, atol=0.02)
    assert rms == pytest.approx(clean_rms, rel=0.01)


def test_a_small_sky_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"\d+ unmasked pixels of blank sky, at least 1000 are needed"):
        sky_noise(np.random.default_rng(6).standard_normal(SHAPE), around(88.0))


def test_neighbours() -> None:
    assert neighbours(EXPECTED) == pytest.approx((EXPECTED[2, 3], EXPECTED[3, 2], EXPECTED[3, 3]))
    assert EXPECTED[2, 3] != pytest.approx(EXPECTED[3, 2], abs=0.1)


def test_checked_correlation() -> None:
    np.testing.assert_allclose(checked_correlation(3.0 * EXPECTED), EXPECTED)
    lopsided, large, impossible, empty = (EXPECTED.copy() for _ in range(4))
    lopsided[0, 0] += 0.1
    large[2, 1] = large[2, 3] = 1.2
    impossible[2, 1] = impossible[2, 3] = -0.9
    empty[2, 2] = np.nan
    for wrong, reason in (
        (EXPECTED[:4, :4], "equal, odd sides"),
        (EXPECTED[:, 1:4], "equal, odd sides"),
        (lopsided, "the same at opposite offsets"),
        (large, "largest in the middle"),
        (impossible, r"\d+% of its power spectrum is negative"),
        (empty, "must be finite"),
        (-EXPECTED, "positive in the middle"),
    ):
        with pytest.raises(ValueError, match=reason):
            checked_correlation(wrong)


@pytest.mark.parametrize("mapped", [False, True], ids=["exposure", "noise map"])
def test_noise_of_a_mock(mapped: bool) -> None:
    """Each pixel's variance is that of independent noise, where the image is bright and where it is not."""
    rng = np.random.default_rng(7)
    image = np.zeros(SHAPE)
    image[:, 75:] = 4.0
    independent = NoiseModel(0.02, 1000.0)
    sigma = independent.sigma(image)
    model = NoiseModel(None, None, EXPECTED) if mapped else NoiseModel(0.02, 1000.0, EXPECTED)
    noise = np.array(
        [model.draw(image, sigma if mapped else np.full(SHAPE, np.nan), rng) - image for _ in range(80)]
    )
    for half in (np.s_[:, :, 4:70], np.s_[:, :, 80:146]):
        assert noise[half].std() == pytest.approx(sigma[half[1:]].mean(), rel=0.01)
        assert noise[half].mean() == pytest.approx(0.0, abs=0.02 * sigma[half[1:]].mean())
        row = np.mean(noise[half][..., 1:] * noise[half][..., :-1]) / noise[half].var()
        assert row == pytest.approx(EXPECTED[2, 3], abs=0.01)
    masked = model.draw(image, np.full(SHAPE, np.inf), rng)
    assert np.array_equal(masked, image) == mapped  # a noise map without noise adds none
