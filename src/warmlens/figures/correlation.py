"""Figure of the summaries: C(dr) and the cumulative distribution of Delta R, of samples and observation."""

from __future__ import annotations

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from warmlens.figures.draw.axes import SUMMARY_LABELS, set_signal_scale
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.figures.recipe import panel_table
from warmlens.figures.samples import SUMMARY_GRIDS, Summaries, read_summaries, split_by_value

N_TERCILES = 3
SCATTER = (16.0, 84.0)

read = read_summaries


def draw(data: Summaries) -> Figure:
    """Draw C(dr) and the cumulative distribution."""
    figure, axes = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, 3.2))
    for ax, kind in zip(axes, data.grids, strict=True):
        draw_terciles(ax, data, kind)
    axes[0].set_ylabel(r"$C({\rm d}r) = \langle \Delta R(r)\,\Delta R(r+{\rm d}r)\rangle$")
    return figure


def draw_terciles(ax: Axes, data: Summaries, kind: str) -> None:
    """Draw mean (line) and scatter (band) of the samples in terciles of m_TH, and the observation in black."""
    grid, samples, observed = data.grids[kind], data.samples[kind], data.observed[kind]
    m_kev = data.parameters["m_th_kev"].to_numpy()
    colours = mpl.rcParams["axes.prop_cycle"].by_key()["color"]
    for rows, colour in zip(split_by_value(m_kev, N_TERCILES), colours, strict=False):
        label = rf"${m_kev[rows].min():.1f} < m_{{\rm TH}}/{{\rm keV}} < {m_kev[rows].max():.1f}$"
        ax.fill_between(grid, *np.percentile(samples[rows], SCATTER, axis=0), color=colour, alpha=0.16, lw=0)
        ax.plot(grid, samples[rows].mean(axis=0), color=colour, label=label)
    ax.plot(grid, observed, color="black", lw=2.6, label="observation", zorder=5)
    ax.legend(title="mean, 16th to 84th percentile", title_fontsize=8.5, alignment="left")
    set_signal_scale(ax, np.concatenate([samples.mean(axis=0), observed]))
    ax.set_xlim(grid[0], grid[-1])
    across, up = SUMMARY_LABELS[kind]
    ax.set_xlabel(across)
    ax.set_ylabel(up)


def tabulate(data: Summaries) -> pd.DataFrame:
    """Return mean and 16th to 84th percentile of each group in m_TH, and the observation."""
    m_kev = data.parameters["m_th_kev"].to_numpy()
    panels = {}
    for kind, (_, column) in SUMMARY_GRIDS.items():
        grid = data.grids[kind]
        curves = [pd.DataFrame({column: grid, "group": "observation", "mean": data.observed[kind]})]
        for rows in split_by_value(m_kev, N_TERCILES):
            values = data.samples[kind][rows]
            low, high = np.percentile(values, SCATTER, axis=0)
            curve = pd.DataFrame({column: grid, "mean": values.mean(axis=0), "p16": low, "p84": high})
            ends = {"m_th_low_kev": m_kev[rows].min(), "m_th_high_kev": m_kev[rows].max(), "n_samples": len(rows)}
            curves.append(curve.assign(group="samples", **ends))
        panels[kind] = pd.concat(curves, ignore_index=True)
    return panel_table(panels)
