"""Checks of a noise map: pixels that it takes out of the fit, and its size against the scatter of the image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from warmlens.types import BoolArray, FloatArray

# Noise of a pixel over that of the quiet ones: from the first on it says nothing, from the second on it is masked.
FAINT_NOISE, IGNORED_NOISE = 10.0, 100.0
_QUIET_PERCENTILE = 5.0
_TINY_NOISE = 1.0 / 30.0
_FAINT_SHARE, _BRIGHT_SHARE = 0.25, 0.25  # of the used pixels, by smoothed brightness
_SMOOTHING = 7  # pixels: selects faint regions, not faint pixels, whose noise is negative
_FAR_LAG = 3  # pixels; drizzling hardly correlates them
_MIN_DIFFERENCES = 100
DEEP = 10.0  # sigma below the sky: no noise, and no source


class Uninformative(NamedTuple):
    """Used pixels [ny, nx] whose noise exceeds their brightness and that of the quiet pixels by far."""

    ignored: BoolArray  # by more than 100 times: they are masked
    ambiguous: BoolArray  # by 10 to 100 times
    too_quiet: BoolArray  # noise below 1/30 of that of the quiet pixels
    quiet_sigma: float  # 5th percentile of the noise of the used pixels


def uninformative(image: FloatArray, sigma: FloatArray, used: BoolArray) -> Uninformative:
    """Return the pixels that a noise map takes out of the fit, or gives a weight that no pixel has.

    A pixel of huge noise adds nothing to chi2, but counts among its pixels: chi2_red would be too small. Pixels
    brighter than their noise are measured, however large it is beside that of the sky (cores of quasars).
    """
    noise = np.where(used & (sigma > 0.0) & np.isfinite(sigma), sigma, np.nan)
    if np.isnan(noise).all():
        none = np.zeros(image.shape, dtype=bool)
        return Uninformative(used & np.isposinf(sigma), none, none, np.nan)
    quiet = float(np.nanpercentile(noise, _QUIET_PERCENTILE))
    with np.errstate(invalid="ignore"):
        buried = used & ~(np.abs(image) > sigma)
        ignored = buried & (sigma > IGNORED_NOISE * quiet)
        return Uninformative(
            ignored, buried & (sigma > FAINT_NOISE * quiet) & ~ignored, noise < _TINY_NOISE * quiet, quiet
        )


@dataclass(frozen=True)
class Scatter:
    """Robust scatter of an image over its sigma, from second differences of pixels along rows and columns.

    What is linear in the position drops out. Structure of the image raises the ratios, correlation of the noise
    lowers that of neighbours.

    Attributes
    ----------
    sky
        Of pixels 3 apart in the faintest quarter of the used pixels: too high at most.
    sky_neighbours, bright_neighbours
        Of neighbouring pixels in the faintest and in the brightest quarter.
    sky_sigma
        Median sigma of the faintest quarter.
    n_pixels
        Number of the differences 3 apart.
    n_constant, n_deep
        Pixels that equal their neighbours exactly, and that lie 10 sigma below the faintest quarter: no data.
    """

    sky: float
    sky_neighbours: float
    bright_neighbours: float
    sky_sigma: float
    n_pixels: int
    n_constant: int
    n_deep: int

    @property
    def bright(self) -> float:
        """Scatter of the brightest quarter, free of the correlation that the sky has: too high at most."""
        return self.bright_neighbours * self.sky / self.sky_neighbours


def measure_scatter(image: FloatArray, sigma: FloatArray, used: BoolArray) -> Scatter | None:
    """Compare the scatter of the used pixels with their noise; None if there are too few in one piece."""
    share = ndimage.uniform_filter(used.astype(np.float64), _SMOOTHING)
    smooth = ndimage.uniform_filter(np.where(used, image, 0.0), _SMOOTHING) / np.maximum(share, 1e-6)
    ranked = smooth[used]
    faint = used & (smooth <= np.quantile(ranked, _FAINT_SHARE))
    bright = used & (smooth >= np.quantile(ranked, 1.0 - _BRIGHT_SHARE))
    near, near_used = _second_differences(image, sigma, used, 1)
    far, far_used = _second_differences(image, sigma, used, _FAR_LAG)
    regions = (far[far_used & faint], near[near_used & faint], near[near_used & bright])
    real = [values[values != 0.0] for values in regions]
    if min(values.size for values in real) < _MIN_DIFFERENCES:
        return None
    sky, sky_neighbours, bright_neighbours = (float(1.4826 * np.median(np.abs(values))) for values in real)
    constant = int(np.count_nonzero(near_used & (near == 0.0)))
    deep = int(np.count_nonzero(used & (image < np.median(image[faint]) - DEEP * sigma)))
    sky_sigma = float(np.median(sigma[faint]))
    return Scatter(sky, sky_neighbours, bright_neighbours, sky_sigma, real[0].size, constant, deep)


def _second_differences(
    image: FloatArray, sigma: FloatArray, used: BoolArray, lag: int
) -> tuple[FloatArray, BoolArray]:
    """Return second differences along both axes over the noise that independent pixels give them, and where."""
    line = np.zeros(2 * lag + 1)
    line[[0, lag, -1]] = 1.0, -2.0, 1.0
    kernel = np.outer(line, line)

    def total(values: FloatArray, weights: FloatArray) -> FloatArray:
        return ndimage.convolve(np.where(used, values, 0.0), weights, mode="constant")

    where = ndimage.binary_erosion(used, structure=kernel != 0.0)
    variance = total(sigma**2, kernel**2)
    return total(image, kernel) / np.sqrt(np.where(where, variance, 1.0)), where
