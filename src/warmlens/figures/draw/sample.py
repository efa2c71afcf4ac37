"""One sample against the observation and the accepted samples."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from warmlens.figures.draw.axes import set_signal_scale
from warmlens.imaging.grid import PixelGrid
from warmlens.types import FloatArray

SAMPLE_COLOUR, BAND_COLOUR = "#c1403d", "#2f6f9f"
_NOTHING = 1e-6  # of the largest value of a summary: rounding, which the ordinate need not show
MARKED = 20  # heaviest subhalos that are circled


def draw_summary(
    ax: Axes, grid: FloatArray, accepted: FloatArray, observed: FloatArray, sample: FloatArray | None
) -> None:
    """Draw a summary of one sample and of the observation over the range of the accepted samples.

    Parameters
    ----------
    ax, grid
        Where to draw, with a symmetric-logarithmic ordinate, and the abscissa [n].
    accepted
        2.5, 16, 50, 84 and 97.5% of the accepted samples at each point [5, n].
    observed, sample
        Summary of the observation, and of the sample unless it failed [n].
    """
    low, lower, median, upper, high = accepted
    ax.fill_between(grid, low, high, color=BAND_COLOUR, alpha=0.15, lw=0, label="accepted, 95%")
    ax.fill_between(grid, lower, upper, color=BAND_COLOUR, alpha=0.3, lw=0, label="accepted, 68%")
    ax.plot(grid, observed, color="black", lw=2.4, label="observation", zorder=4)
    if sample is not None:
        ax.plot(grid, sample, color=SAMPLE_COLOUR, lw=1.6, label="this sample", zorder=5)
    shown = np.concatenate([median, observed])
    set_signal_scale(ax, shown[shown > _NOTHING * shown.max()])
    ax.set_xlim(grid[0], grid[-1])


def mark_subhalos(
    ax: Axes, x_arcsec: FloatArray, y_arcsec: FloatArray, m_bound_msun: FloatArray, image: PixelGrid
) -> None:
    """Circle the heaviest of the subhalos [n], radius by the cube root of the mass, and frame the image."""
    for i in np.argsort(m_bound_msun)[::-1][:MARKED]:
        radius = 0.12 * np.cbrt(m_bound_msun[i] / 1e9)
        ax.add_patch(Circle((x_arcsec[i], y_arcsec[i]), radius, fc="none", ec="white", lw=0.7, alpha=0.9))
    x, y = image.coordinates()
    half = 0.5 * image.pixel_scale
    corner = (x.min() - half, y.min() - half)
    size = (x.max() - x.min() + 2.0 * half, y.max() - y.min() + 2.0 * half)
    ax.add_patch(Rectangle(corner, *size, fc="none", ec="white", lw=0.8, ls="--"))
