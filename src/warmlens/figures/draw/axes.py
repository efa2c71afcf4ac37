"""Labels, legends and scales that panels of several figures share."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from warmlens.types import FloatArray

MASS_LABEL = r"$m_{\rm TH}$ [keV]"
BOUND_LABEL = r"lower bound on $m_{\rm TH}$ [keV]"
SUMMARY_LABELS = {  # abscissa and ordinate
    "correlation": (r"${\rm d}r$ [arcsec]", r"$C({\rm d}r)$"),
    "cumulative": (r"$\Delta R$", r"fraction of positions below $\Delta R$"),
}
_LINEAR_BELOW_PERCENTILE = 5.0


def legend_above(
    ax: Axes, n_columns: int = 1, corner: tuple[float, float] = (-0.02, 0.99), **options: Any
) -> None:
    """Put the legend between a panel and its title, where it hides nothing.

    Its lower left corner is in units of the panel; options are more of `Axes.legend`.
    """
    ax.legend(loc="lower left", bbox_to_anchor=corner, ncols=n_columns, borderaxespad=0.1, **options)


def label_panel(ax: Axes, text: str, colour: str = "white", ground: str = "black") -> None:
    """Write on a ground in the upper left corner of a panel."""
    box = {"boxstyle": "square,pad=0.15", "fc": ground, "ec": "none", "alpha": 0.7}
    ax.text(0.04, 0.95, text, transform=ax.transAxes, color=colour, ha="left", va="top", fontsize=8.5, bbox=box)


def mask_not_positive(values: FloatArray) -> FloatArray:
    """Return the values with NaN where a logarithmic axis cannot show them."""
    return np.where(values > 0.0, values, np.nan)


def set_signal_scale(ax: Axes, values: FloatArray) -> None:
    """Start the ordinate at 0, linear up to the decade of the lowest values that matter, logarithmic beyond.

    A sample without anomalies has 0 everywhere, which a logarithmic ordinate would not show. `values` are what
    the panel shows most prominently, of any shape; if all are 0, the ordinate stays linear.
    """
    if (values > 0.0).any():
        lowest = np.percentile(values[values > 0.0], _LINEAR_BELOW_PERCENTILE)
        ax.set_yscale("symlog", linthresh=float(10.0 ** np.floor(np.log10(lowest))), linscale=0.6)
    ax.set_ylim(bottom=0.0)
