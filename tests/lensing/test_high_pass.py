from __future__ import annotations

import numpy as np
import pytest

from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.high_pass import crop, effective_sigma_pixels, high_pass, margin_pixels

SIGMA, PIXEL = 0.4, 0.05


@pytest.fixture
def coordinates():
    return PixelGrid.centred((128, 150), PIXEL).coordinates()


def test_constant_and_linear_fields_vanish_inside(coordinates):
    x, y = coordinates
    margin = margin_pixels(SIGMA, PIXEL)
    field = np.stack([3.0 + 0.2 * x - 0.1 * y, np.full(x.shape, -1.5)])
    filtered = high_pass(field, SIGMA, PIXEL)
    assert np.abs(crop(filtered, margin)).max() < 1e-12
    assert np.abs(filtered[0]).max() > 1e-2  # and the edge does not: the crop is needed


@pytest.mark.parametrize("wavelength", [0.5, 1.5, 3.0, 6.0])
def test_a_single_mode_is_damped_as_the_gaussian_says(coordinates, wavelength):
    x, y = coordinates
    k = 2 * np.pi / wavelength
    mode = np.cos(k * (0.6 * x + 0.8 * y))
    margin = margin_pixels(SIGMA, PIXEL)
    filtered = crop(high_pass(np.stack([mode, 2 * mode]), SIGMA, PIXEL), margin)
    expected = (1 - np.exp(-0.5 * (k * SIGMA) ** 2)) * crop(mode, margin)
    np.testing.assert_allclose(filtered, np.stack([expected, 2 * expected]), atol=4e-4)


def test_margin_is_just_enough():
    margin = margin_pixels(SIGMA, PIXEL)
    assert margin == 32
    rng = np.random.default_rng(2)
    field = rng.normal(size=(2, 100, 100))
    other = field.copy()
    other[:, 0, :] += 1.0  # a row at the very edge reaches `margin` rows and no further
    difference = np.abs(high_pass(other, SIGMA, PIXEL) - high_pass(field, SIGMA, PIXEL)).max(axis=(0, 2))
    assert (difference[margin + 1 :] == 0.0).all()
    assert difference[margin] > 0.0


def test_crop_undoes_padding():
    grid = PixelGrid.centred((8, 11), PIXEL)
    x, y = grid.padded(5).coordinates()
    np.testing.assert_allclose(crop(np.stack([x, y]), 5), np.stack(grid.coordinates()), atol=1e-12)
    assert crop(x, 0).shape == x.shape


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="sigma_arcsec"):
        margin_pixels(0.0, PIXEL)
    with pytest.raises(ValueError, match="finite"):
        high_pass(np.full((2, 4, 4), np.nan), SIGMA, PIXEL)
    with pytest.raises(ValueError, match="margin"):
        crop(np.zeros((4, 6)), 2)


def b3_response(k: float, steps: list[int]) -> float:
    """Fourier transform of the B3 splines [1 4 6 4 1] / 16 with taps `step` pixels apart, along one axis."""
    return float(np.prod([np.cos(0.5 * k * PIXEL * step) ** 4 for step in steps]))


@pytest.mark.parametrize("wavelength", [0.5, 1.5, 3.0, 6.0])
def test_starlet_damps_a_mode_as_the_splines_say(coordinates, wavelength):
    x, y = coordinates
    k = 2 * np.pi / wavelength
    mode = np.cos(k * (0.6 * x + 0.8 * y))
    margin = margin_pixels(SIGMA, PIXEL, "starlet")
    filtered = crop(high_pass(mode, SIGMA, PIXEL, "starlet"), margin)
    passed = [b3_response(0.6 * k, steps) * b3_response(0.8 * k, steps) for steps in ([1, 2, 4, 8], [1, 2, 4])]
    np.testing.assert_allclose(filtered, (1 - passed[0]) * crop(mode, margin), atol=1e-12)
    if wavelength > 1.0:  # one scale less is another filter
        assert abs(passed[1] - passed[0]) > 1e-2


def test_median_wavelet_is_the_running_medians(coordinates):
    """Windows of 7, 13 and 25 pixels, one after another, against plain medians of slices."""
    rng = np.random.default_rng(5)
    field = rng.normal(size=(60, 60))
    filtered = high_pass(field, SIGMA, PIXEL, "median_wavelet")
    smooth = field
    for half in (3, 6, 12):
        windows = np.lib.stride_tricks.sliding_window_view(smooth, (2 * half + 1, 2 * half + 1))
        smooth = np.median(windows, axis=(2, 3))
    assert margin_pixels(SIGMA, PIXEL, "median_wavelet") == 21
    np.testing.assert_allclose(crop(filtered, 21), crop(field, 21) - smooth, atol=1e-14)


@pytest.mark.parametrize("kind", ["starlet", "median_wavelet"])
def test_alternatives_take_off_what_is_smooth(coordinates, kind):
    x, y = coordinates
    margin = margin_pixels(SIGMA, PIXEL, kind)
    linear = high_pass(np.stack([3.0 + 0.2 * x - 0.1 * y, np.full(x.shape, -1.5)]), SIGMA, PIXEL, kind)
    assert np.abs(crop(linear, margin)).max() < 1e-12
    assert np.abs(linear[0]).max() > 1e-3
    # to lowest order the smoothing adds sigma^2 / 2 times the Laplacian
    sigma = PIXEL * effective_sigma_pixels(SIGMA, PIXEL, kind)
    quadratic = high_pass(0.5 * (x**2 + y**2), SIGMA, PIXEL, kind)
    if kind == "starlet":
        np.testing.assert_allclose(crop(quadratic, margin), -(sigma**2), rtol=1e-9)
    level = quadratic[63:65, 74:76]  # a median: 4.5% less at each window than a mean, and more after a slope
    np.testing.assert_allclose(level, -(sigma**2), rtol=0.16)


@pytest.mark.parametrize("kind", ["starlet", "median_wavelet"])
def test_margin_of_the_alternatives(kind):
    """Nothing beyond the margin changes the crop; what lies on it does."""
    margin = margin_pixels(SIGMA, PIXEL, kind)
    field = np.random.default_rng(2).normal(size=(2, 100, 100))
    other = field.copy()
    other[:, 0, :] += 1e6
    difference = np.abs(high_pass(other, SIGMA, PIXEL, kind) - high_pass(field, SIGMA, PIXEL, kind)).max(
        axis=(0, 2)
    )
    assert (difference[margin + 1 :] == 0.0).all()
    assert (difference[: margin // 2] > 0.0).all()


@pytest.mark.parametrize("sigma", np.geomspace(1.0, 30.0, 12))
def test_scales_are_the_nearest(sigma):
    assert 2**-0.5 - 0.02 < effective_sigma_pixels(sigma * PIXEL, PIXEL, "starlet") / sigma < 2**0.5 + 0.2
    assert 0.75 < effective_sigma_pixels(sigma * PIXEL, PIXEL, "median_wavelet") / sigma < 1.33
    assert effective_sigma_pixels(sigma * PIXEL, PIXEL, "gaussian") == pytest.approx(sigma)


def test_widths_at_the_paper_s_scale():
    """0.4 arcsec on pixels of 0.05 arcsec: sqrt(1 + 4 + 16 + 64) and sqrt((48 + 168 + 624) / 12) pixels."""
    assert effective_sigma_pixels(SIGMA, PIXEL, "starlet") == pytest.approx(85**0.5)
    assert effective_sigma_pixels(SIGMA, PIXEL, "median_wavelet") == pytest.approx(70**0.5)


def test_bad_filters_are_refused():
    with pytest.raises(ValueError, match=r"deflections\.filter must be one of gaussian, starlet, median_wavelet"):
        high_pass(np.zeros((4, 4)), SIGMA, PIXEL, "wavelet")
    for kind in ("starlet", "median_wavelet"):
        with pytest.raises(ValueError, match=r"filter_arcsec is 0\.2 pixels.*use deflections.filter: gaussian"):
            margin_pixels(0.2 * PIXEL, PIXEL, kind)
