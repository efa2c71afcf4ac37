"""Correlation of the noise between pixels, as drizzling causes it: measured, checked and drawn.

A correlation function is an array [2 r + 1, 2 r + 1] of offsets (row, column) from -r to r. It is 1 in the middle,
symmetric under a change of sign of the offset, and 0 beyond.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import polynomial
from scipy import fft

from warmlens.types import BoolArray, FloatArray

REACH = 2  # pixels; drizzling correlates 2 if its pixels are half as wide as the detector's, 1 if they are equal
MIN_SKY_PIXELS = 1000  # with these the correlation of independent noise scatters by 0.03
_ORDER = 4  # of the polynomial that is subtracted from blank sky
_CLIP = 4.0  # sigma; pixels of blank sky beyond are sources
_CLIP_ROUNDS = 5
_LOST_POWER = 0.02  # share of the power of a correlation function that may be negative


def autocorrelation(values: FloatArray, used: BoolArray, reach: int = REACH) -> FloatArray:
    """Return the correlation function of the used pixels of an image [ny, nx] of zero mean.

    At each offset it is the mean product over pairs of used pixels that far apart, over the variance.

    Raises
    ------
    ValueError
        If the image is smaller than the offsets, or some offset has no pair.
    """
    if min(values.shape) <= reach:
        raise ValueError(f"an image of {values.shape} pixels has no pairs {reach} pixels apart")
    shape = [fft.next_fast_len(side + reach, real=True) for side in values.shape]

    def pairs(image: FloatArray) -> FloatArray:
        product = fft.irfft2(np.abs(fft.rfft2(image, shape)) ** 2, shape)
        return np.roll(product, (reach, reach), axis=(0, 1))[: 2 * reach + 1, : 2 * reach + 1]

    counts = np.rint(pairs(used.astype(np.float64)))
    if counts.min() < 1:
        raise ValueError(f"no two of {np.count_nonzero(used)} pixels are {reach} apart in some direction")
    covariance = pairs(np.where(used, values, 0.0)) / counts
    return covariance / covariance[reach, reach]


def sky_noise(image: FloatArray, sky: BoolArray) -> tuple[FloatArray, float]:
    """Measure the correlation function and the rms of the noise of an image [ny, nx] in its pixels of blank sky.

    A polynomial of fourth order is subtracted, and pixels beyond 4 sigma are left out. The polynomial also removes
    noise, which is corrected for: its p coefficients lower the covariance of n pixels at every offset by S p / n
    times the variance, with S the sum of the correlation function.

    Raises
    ------
    ValueError
        If there are fewer than 1000 such pixels.
    """
    y, x = (np.linspace(-1.0, 1.0, side) for side in image.shape)
    surface = np.moveaxis(polynomial.polyvander2d(*np.meshgrid(x, y), [_ORDER, _ORDER]), -1, 0)
    powers = np.add.outer(np.arange(_ORDER + 1), np.arange(_ORDER + 1)).ravel()
    surface = surface[powers <= _ORDER]
    used = sky.copy()
    for _ in range(_CLIP_ROUNDS):
        if np.count_nonzero(used) < MIN_SKY_PIXELS:
            raise ValueError(
                f"{np.count_nonzero(used)} unmasked pixels of blank sky, at least {MIN_SKY_PIXELS} are needed "
                "to measure how noise is correlated"
            )
        rest = image - np.tensordot(np.linalg.lstsq(surface[:, used].T, image[used])[0], surface, axes=1)
        rms = float(np.sqrt(np.mean(rest[used] ** 2)))
        kept = used & (np.abs(rest) <= _CLIP * rms)
        if np.array_equal(kept, used):
            break
        used = kept
    raw = autocorrelation(rest, used)
    share = len(surface) / np.count_nonzero(used)  # p / n
    # raw = (rho - S p/n) / (1 - S p/n), summed over the offsets and solved for S
    total = raw.sum() / (1.0 - share * (raw.size - raw.sum()))
    return raw * (1.0 - total * share) + total * share, rms / np.sqrt(1.0 - total * share)


def checked_correlation(covariance: FloatArray) -> FloatArray:
    """Normalise a covariance in any unit to a correlation function, and check that noise can have it.

    Raises
    ------
    ValueError
        If it is no correlation function. Negative power up to 2% of all is noise of the measurement and accepted;
        `correlate` sets it to zero.
    """
    if covariance.ndim != 2 or covariance.shape[0] != covariance.shape[1] or covariance.shape[0] % 2 == 0:
        raise ValueError(f"a correlation function has equal, odd sides, this one has {covariance.shape}")
    middle = covariance.shape[0] // 2
    if not (np.isfinite(covariance).all() and covariance[middle, middle] > 0.0):
        raise ValueError("a correlation function must be finite, and positive in the middle")
    correlation = covariance / covariance[middle, middle]
    if np.abs(correlation - correlation[::-1, ::-1]).max() > 1e-6:
        raise ValueError("a correlation function must be the same at opposite offsets from the middle")
    if np.abs(correlation).max() > 1.0:
        raise ValueError("a correlation function is largest in the middle")
    power = _power(correlation, tuple(4 * side for side in correlation.shape))
    lost = -np.minimum(power, 0.0).sum() / power.sum()
    if not lost <= _LOST_POWER:
        raise ValueError(
            f"no noise has this correlation function: {lost:.0%} of its power spectrum is negative; measure it on "
            "more pixels, or shorten it"
        )
    return correlation


def correlate(white: FloatArray, correlation: FloatArray) -> FloatArray:
    """Filter independent noise of unit variance [ny, nx] to noise of unit variance with a correlation function.

    The filter is the root of the power spectrum. The field is periodic: opposite edges of the image are correlated
    as neighbours are.
    """
    amplitude = np.sqrt(np.maximum(_power(correlation, white.shape), 0.0))
    # unit variance: the mean of the power over all wave numbers is 1
    amplitude /= np.sqrt(np.mean(amplitude**2))
    return fft.ifft2(fft.fft2(white) * amplitude).real


def neighbours(correlation: FloatArray) -> tuple[float, float, float]:
    """Return the correlation of neighbours along rows, along columns, and across the diagonals (their mean)."""
    c = correlation.shape[0] // 2
    diagonal = 0.5 * (correlation[c + 1, c + 1] + correlation[c + 1, c - 1])
    return float(correlation[c, c + 1]), float(correlation[c + 1, c]), float(diagonal)


def _power(correlation: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Return the power spectrum on a periodic image; the mean over all wave numbers is the variance, 1."""
    reach = correlation.shape[0] // 2
    wrapped = np.zeros(shape)
    wrapped[: 2 * reach + 1, : 2 * reach + 1] = correlation
    return fft.fft2(np.roll(wrapped, (-reach, -reach), axis=(0, 1))).real
