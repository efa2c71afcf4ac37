"""The likelihood ratio in the thermal relic mass."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from warmlens.types import FloatArray

COLOUR, CROSSING_COLOUR = "#1f5f8b", "#c1403d"
_MAX_OVER_PEAK = 10.0  # a band that reaches higher is cut off: few samples at the upper end of the prior


def draw_likelihood_ratio(
    ax: Axes, m_kev: FloatArray, ratio: FloatArray, band: FloatArray, crossings: FloatArray
) -> None:
    """B(m) with its band, and where it falls to given values, on a logarithmic ordinate.

    Parameters
    ----------
    ax
        Where to draw.
    m_kev, ratio
        Grid [keV] and B on it, each [n].
    band
        16 and 84% quantiles of B over bootstrapped tables [2, n].
    crossings
        Value of B, where it falls to it [keV] and the error of that [keV], [n_values, 3]; NaN where it does not.
    """
    lowest = float(np.nanmin(crossings[:, 0]))
    floor = 0.5 * lowest
    ax.fill_between(m_kev, np.maximum(band[0], floor), np.maximum(band[1], floor), color=COLOUR, alpha=0.2, lw=0)
    ax.plot(m_kev, np.maximum(ratio, floor), color=COLOUR, label=r"$B(m_{\rm TH})$, 16 to 84%")
    ax.axhline(1.0, color="0.6", lw=0.8)
    for value, mass, error in crossings:
        ax.axhline(value, color=CROSSING_COLOUR, lw=0.8, ls="--")
        where = f"{mass:.2f}" + (rf" $\pm$ {error:.2f}" if np.isfinite(error) else "") + " keV"
        name = f"1/{1.0 / value:.3g}: " + (where if np.isfinite(mass) else "not reached")
        ax.text(m_kev[-1], 1.06 * value, name + " ", ha="right", va="bottom", fontsize=8, color=CROSSING_COLOUR)
        if np.isfinite(mass):
            ax.errorbar(mass, value, xerr=np.nan_to_num(error), fmt="o", ms=4, lw=1.1, color=CROSSING_COLOUR)
    ax.set_yscale("log")
    ax.set_xlim(m_kev[0], m_kev[-1])
    ax.set_ylim(floor, 1.6 * min(float(band[1].max()), _MAX_OVER_PEAK * max(1.0, float(ratio.max()))))
    ax.set_ylabel(r"$B(m_{\rm TH})$ over its value at " + f"{m_kev[-1]:g} keV")
    ax.legend(loc="lower left", bbox_to_anchor=(-0.02, 0.99), borderaxespad=0.1)
