"""Summaries of the samples against those of the observation."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

from warmlens.types import FloatArray

SCATTER = (16.0, 84.0)
LINEAR_BELOW_PERCENTILE = 5.0


def draw_correlations(
    ax: Axes,
    dr_arcsec: FloatArray,
    samples: FloatArray,
    m_kev: FloatArray,
    observed: FloatArray,
    n_groups: int = 3,
) -> None:
    """C(dr) of the samples in groups of thermal relic mass, and of the observation in black.

    Parameters
    ----------
    ax
        Where to draw; its ordinate becomes symmetric-logarithmic, linear around 0.
    dr_arcsec
        Separations [arcsec], [n_dr].
    samples
        C(dr) of each sample, [n, n_dr].
    m_kev
        Thermal relic mass of each sample [keV], [n].
    observed
        C(dr) of the observation, [n_dr].
    n_groups
        Number of groups of equal size; 3 for terciles.
    """
    _draw_groups(ax, dr_arcsec, samples, m_kev, observed, n_groups)
    ax.set_xlabel(r"${\rm d}r$ [arcsec]")
    ax.set_ylabel(r"$C({\rm d}r) = \langle \Delta R(r)\,\Delta R(r+{\rm d}r)\rangle$")


def draw_cumulatives(
    ax: Axes,
    thresholds: FloatArray,
    samples: FloatArray,
    m_kev: FloatArray,
    observed: FloatArray,
    n_groups: int = 3,
) -> None:
    """N(< Delta R) of the samples in groups of thermal relic mass; parameters as in `draw_correlations`."""
    _draw_groups(ax, thresholds, samples, m_kev, observed, n_groups)
    ax.set_xlabel(r"$\Delta R$")
    ax.set_ylabel(r"fraction of positions below $\Delta R$")


def group_by_mass(m_kev: FloatArray, n_groups: int) -> list[np.ndarray]:
    """Rows of each group, from the lowest masses to the highest; sizes differ by at most one."""
    if not 1 <= n_groups <= m_kev.size:
        raise ValueError(f"n_groups must lie in [1, {m_kev.size}], got {n_groups}")
    return np.array_split(np.argsort(m_kev, kind="stable"), n_groups)


def _draw_groups(
    ax: Axes, grid: FloatArray, samples: FloatArray, m_kev: FloatArray, observed: FloatArray, n_groups: int
) -> None:
    """Mean (line) and 16th to 84th percentile (band) of each group, the observation on top.

    A sample without anomalies has 0 everywhere, which a logarithmic ordinate would not show.
    """
    colours = mpl.rcParams["axes.prop_cycle"].by_key()["color"]
    for number, rows in enumerate(group_by_mass(m_kev, n_groups)):
        colour = colours[number % len(colours)]
        group = samples[rows]
        label = rf"${m_kev[rows].min():.1f} < m_{{\rm TH}}/{{\rm keV}} < {m_kev[rows].max():.1f}$"
        ax.fill_between(grid, *np.percentile(group, SCATTER, axis=0), color=colour, alpha=0.16, lw=0)
        ax.plot(grid, group.mean(axis=0), color=colour, label=label)
    ax.plot(grid, observed, color="black", lw=2.6, label="observation", zorder=5)
    ax.legend(title="mean, 16th to 84th percentile", title_fontsize=8.5, alignment="left")
    set_signal_scale(ax, np.concatenate([samples.mean(axis=0), observed]))
    ax.set_xlim(grid[0], grid[-1])


def set_signal_scale(ax: Axes, values: FloatArray) -> None:
    """Ordinate from 0, linear up to the decade of the lowest values that matter, logarithmic beyond.

    `values` are what the panel shows most prominently, of any number; all 0 leaves the ordinate linear.
    """
    if (values > 0.0).any():
        lowest = np.percentile(values[values > 0.0], LINEAR_BELOW_PERCENTILE)
        ax.set_yscale("symlog", linthresh=float(10.0 ** np.floor(np.log10(lowest))), linscale=0.6)
    ax.set_ylim(bottom=0.0)
