"""How bound and scan move when one thing of a campaign is changed: one line per variant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from matplotlib.axes import Axes
from matplotlib.ticker import AutoMinorLocator

from warmlens.figures.draw.axes import BOUND_LABEL, legend_above
from warmlens.figures.draw.style import BLUE, RED

FAINT = "0.45"


class Variant(Protocol):
    """What is drawn of one variant; missing numbers are None."""

    @property
    def name(self) -> str:
        """Label of its line."""

    @property
    def group(self) -> str:
        """Heading over neighbouring variants."""

    @property
    def state(self) -> str:
        """`failed` is written in place of a bound."""

    @property
    def bound_kev(self) -> float | None:
        """Lower bound on m_TH [keV]."""

    @property
    def mc_error_kev(self) -> float | None:
        """Its Monte-Carlo error [keV]."""

    @property
    def prior_only_kev(self) -> float | None:
        """Bound of the prior alone [keV]."""

    @property
    def n_below(self) -> int | None:
        """Positions of the observation's scan below the threshold."""

    @property
    def null_n_below(self) -> float | None:
        """Median of the same in the variant's mocks without substructure."""


def line_heights(groups: Sequence[str]) -> list[float]:
    """Return the height of every variant's line, downwards from 0; each further group has a line for its name."""
    heights: list[float] = []
    level = 0.0
    for i, group in enumerate(groups):
        level -= 2.0 if i and group != groups[i - 1] else 1.0
        heights.append(level)
    return heights


def draw_bounds(ax: Axes, rows: Sequence[Variant]) -> None:
    """Draw bound with Monte-Carlo error, and the bound of the prior alone, one line per variant.

    The first variant is the base, whose error is a band through all lines; members of a group are neighbours.
    """
    heights = line_heights([row.group for row in rows])
    base = rows[0]
    if base.bound_kev is not None and base.mc_error_kev is not None:
        low, high = base.bound_kev - base.mc_error_kev, base.bound_kev + base.mc_error_kev
        ax.axvspan(low, high, color=BLUE, alpha=0.12, lw=0)
    for row, height in zip(rows, heights, strict=True):
        if row.bound_kev is not None:
            ax.errorbar(row.bound_kev, height, xerr=row.mc_error_kev, fmt="o", ms=4, color=BLUE, capsize=2)
        else:
            note = "failed" if row.state == "failed" else "scan only"
            ax.annotate(note, (0.98, height), xycoords=("axes fraction", "data"), ha="right", va="center",
                        fontsize=8, color=RED if note == "failed" else FAINT)  # fmt: skip
        if row.prior_only_kev is not None:
            ax.plot(row.prior_only_kev, height, marker="|", ms=9, mew=1.4, color="black", ls="none")
    ax.plot([], [], marker="o", ms=4, color=BLUE, ls="none", label="bound, MC error")
    ax.plot([], [], marker="|", ms=9, mew=1.4, color="black", ls="none", label="prior alone")
    ax.set_yticks(heights, [row.name for row in rows])
    ax.tick_params(axis="y", which="both", length=0)
    ax.yaxis.set_minor_locator(AutoMinorLocator(1))
    previous = base.group
    for row, height in zip(rows, heights, strict=True):
        if row.group != previous:
            ax.annotate(row.group, (0.01, height + 0.9), xycoords=("axes fraction", "data"), va="center",
                        fontsize=8, style="italic", color=FAINT)  # fmt: skip
        previous = row.group
    ax.set_ylim(heights[-1] - 0.7, heights[0] + 0.7)
    ax.xaxis.set_minor_locator(AutoMinorLocator())
    ax.set_xlabel(BOUND_LABEL)
    legend_above(ax, 2, (-0.02, 1.0), handletextpad=0.4)


def draw_scans(ax: Axes, rows: Sequence[Variant]) -> None:
    """Draw the number of positions where a perturber improves the fit; lines as in `draw_bounds`.

    A mark is the number in mocks without substructure: what exceeds it is misfit or substructure.
    """
    heights = line_heights([row.group for row in rows])
    seen = [(row.n_below, h) for row, h in zip(rows, heights, strict=True) if row.n_below is not None]
    null = [(row.null_n_below, h) for row, h in zip(rows, heights, strict=True) if row.null_n_below is not None]
    if rows[0].n_below is not None:
        ax.axvline(rows[0].n_below, color=BLUE, alpha=0.4, lw=1.0)
    ax.plot([n for n, _ in seen], [h for _, h in seen], "o", ms=4, color=BLUE, label="observation")
    if null:
        n_below, level = zip(*null, strict=True)
        ax.plot(n_below, level, marker="|", ms=9, mew=1.4, color="black", ls="none", label="null mocks")
        legend_above(ax, 2, (-0.02, 1.0), handletextpad=0.4)
    ax.set_xlim(0.0, 1.1 * max([n for n, _ in (*seen, *null)], default=1) or 1.0)
    ax.tick_params(axis="y", which="both", length=0)
    ax.set_xlabel(r"positions of the scan below the threshold")
