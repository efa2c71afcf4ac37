"""Figure of the posterior predictive check: summaries of the accepted samples over the observed ones."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from warmlens.figures.draw.axes import SUMMARY_LABELS, set_signal_scale
from warmlens.figures.draw.style import BLUE, FULL_WIDTH_INCH
from warmlens.figures.inputs import Inputs, open_input
from warmlens.figures.samples import SUMMARY_GRIDS, read_observed_summary

QUANTILES = ("p025", "p16", "p50", "p84", "p975")  # of the accepted samples


def read(inputs: Inputs) -> dict[str, pd.DataFrame]:
    """Return observation, quantiles of the accepted samples and predictive p of each kind of summary."""
    grids, observed = read_observed_summary(inputs)
    panels = {}
    with open_input(inputs, "abc") as artifact:
        for kind, (_, column) in SUMMARY_GRIDS.items():
            quantiles = zip(QUANTILES, artifact.array(f"predictive/{kind}/quantiles"), strict=True)
            summary = pd.DataFrame({column: grids[kind], "observed": observed[kind], **dict(quantiles)})
            panels[kind] = summary.assign(p_value=artifact.metadata["posterior_predictive_p"][kind])
    return panels


def draw(panels: dict[str, pd.DataFrame]) -> Figure:
    """Draw C(dr) and the cumulative distribution."""
    figure, axes = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, 3.1))
    for ax, (kind, summary) in zip(axes, panels.items(), strict=True):
        grid, observed = (summary[name].to_numpy() for name in (SUMMARY_GRIDS[kind][1], "observed"))
        p025, p16, p50, p84, p975 = (summary[name].to_numpy() for name in QUANTILES)
        ax.fill_between(grid, p025, p975, color=BLUE, alpha=0.18, lw=0, label="accepted, 95%")
        ax.fill_between(grid, p16, p84, color=BLUE, alpha=0.35, lw=0, label="68%")
        ax.plot(grid, p50, color=BLUE, label="median")
        ax.plot(grid, observed, color="black", lw=2.2, label="observation")
        set_signal_scale(ax, np.concatenate([p84, observed]))
        ax.set_xlim(grid[0], grid[-1])
        ax.set_title(f"posterior predictive $p$ = {summary['p_value'].iloc[0]:.2f}", fontsize=9)
        across, up = SUMMARY_LABELS[kind]
        ax.set_xlabel(across)
        ax.set_ylabel(up)
    axes[0].legend(loc="upper right")
    return figure
