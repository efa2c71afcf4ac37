"""Several bounds on the thermal relic mass side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

HEAD_COLOUR, OTHER_COLOUR = "#c1403d", "#1f5f8b"


@dataclass(frozen=True)
class BoundRow:
    """A bound with its Monte-Carlo error, and what its prior alone gives [keV]; NaN where there is none."""

    name: str
    bound_kev: float
    mc_error_kev: float
    prior_only_kev: float


def draw_bound_rows(ax: Axes, rows: Sequence[BoundRow]) -> None:
    """One bound a line, the first (the headline) on top, with a band of its error through all lines.

    A short bar marks what the prior of the line alone gives; a line without a bound says so.
    """
    places = np.arange(len(rows))
    values, errors, priors = (
        np.array([getattr(row, name) for row in rows]) for name in ("bound_kev", "mc_error_kev", "prior_only_kev")
    )
    ax.axvspan(values[0] - errors[0], values[0] + errors[0], color=HEAD_COLOUR, alpha=0.12, lw=0)
    for first, last, colour in ((0, 1, HEAD_COLOUR), (1, len(rows), OTHER_COLOUR)):
        some = slice(first, last)
        ax.errorbar(
            values[some],
            places[some],
            xerr=np.nan_to_num(errors[some]),
            fmt="o",
            ms=3.5,
            lw=1.1,
            color=colour,
            label=None if first == 0 else "bound",
        )
    ax.plot(priors, places, ls="", marker="|", ms=8, mew=1.1, color="black", label="prior alone")
    centre = float(np.nanmean(np.concatenate([values, priors])))
    for place in places[np.isnan(values)]:
        ax.text(centre, place, "none", ha="center", va="center", fontsize=7.5, color="0.4")
    ax.set_yticks(places, [row.name for row in rows], fontsize=7.5)
    ax.tick_params(axis="y", which="both", left=False, right=False)
    ax.minorticks_off()
    ax.set_ylim(len(rows) - 0.4, -0.6)
    ax.set_xlabel(r"lower bound on $m_{\rm TH}$ [keV]")
    ax.legend(loc="lower left", bbox_to_anchor=(-0.02, 0.99), ncols=2, borderaxespad=0.1)
