"""Fig. 4: C(dr) by halo mass (panels) and thermal relic mass (colours)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from warmlens.figures.draw.axes import SUMMARY_LABELS, set_signal_scale
from warmlens.figures.draw.halo_functions import model_colours
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.figures.inputs import Inputs
from warmlens.figures.samples import Summaries, read_summaries, relic_name, split_by_value
from warmlens.types import BoolArray, FloatArray, IntArray

N_PANELS, N_MODELS, N_REALIZATIONS = 4, 4, 4  # of a campaign without nodes; single samples drawn per model
MAX_NODES = 8
_DASHES = (0, (4, 2))  # of single samples


@dataclass(frozen=True)
class Group:
    """Samples of similar value: a node of a grid, or a range of a continuous prior."""

    # Smallest and largest value; equal at a node
    low: float
    high: float
    rows: IntArray  # which samples [n], rising


@dataclass(frozen=True)
class GroupedSummaries:
    """Summaries of all samples, and their groups in halo mass (panels) and relic mass (models), rising."""

    summaries: Summaries
    panels: tuple[Group, ...]
    models: tuple[Group, ...]

    def members(self, panel: Group) -> Iterator[tuple[int, IntArray]]:
        """Return the number of each model that has samples in a panel, and these samples."""
        for number, model in enumerate(self.models):
            rows = np.intersect1d(panel.rows, model.rows)
            if rows.size:
                yield number, rows


def read(inputs: Inputs) -> GroupedSummaries:
    """Return the summaries of all samples, grouped."""
    return group_summaries(read_summaries(inputs))


def group_summaries(data: Summaries) -> GroupedSummaries:
    """Group samples by halo mass and model: the nodes of a grid, else ranges of equal numbers of samples."""
    masses, relics = (data.parameters[name].to_numpy() for name in ("log10_m_halo_msun", "m_th_kev"))
    panels = group_values(masses, min(N_PANELS, masses.size))
    return GroupedSummaries(data, tuple(panels), tuple(group_values(relics, min(N_MODELS, relics.size))))


def group_values(values: FloatArray, n_groups: int) -> list[Group]:
    """Return nodes if there are at most `MAX_NODES` different values, else `n_groups` ranges of equal numbers."""
    rounded = np.round(values, 6)
    nodes = np.unique(rounded)
    members: list[BoolArray | IntArray]
    if nodes.size <= MAX_NODES:
        members = [np.flatnonzero(rounded == node) for node in nodes]
    else:
        members = list(split_by_value(values, n_groups))
    return [Group(float(values[rows].min()), float(values[rows].max()), np.sort(rows)) for rows in members]


def draw(data: GroupedSummaries) -> Figure:
    """Draw means, some single samples dashed, and the observation in black."""
    grid, values = data.summaries.grids["correlation"], data.summaries.samples["correlation"]
    observed = data.summaries.observed["correlation"]
    n_columns = 2 if len(data.panels) > 1 else 1
    n_rows = -(-len(data.panels) // n_columns)
    size = (FULL_WIDTH_INCH, 0.5 + 2.5 * n_rows)
    figure, axes = plt.subplots(n_rows, n_columns, figsize=size, sharex=True, sharey=True, squeeze=False)
    names = [_model_name(group) for group in data.models]
    colours = list(model_colours(names).values())
    across, up = SUMMARY_LABELS["correlation"]
    for ax, panel in zip(axes.flat, data.panels, strict=False):
        for model, members in data.members(panel):
            for member in members[:N_REALIZATIONS]:
                ax.plot(grid, values[member], color=colours[model], lw=0.5, ls=_DASHES, alpha=0.7)
            ax.plot(grid, values[members].mean(axis=0), color=colours[model])
        ax.plot(grid, observed, color="black", lw=2.6, zorder=5)
        halo_mass = f"{panel.low:g}" if panel.low == panel.high else f"{panel.low:.2f} to {panel.high:.2f}"
        title = rf"$\log_{{10}}(M_{{\rm h}}/{{\rm M}}_\odot)$ = {halo_mass}, {len(panel.rows)} samples"
        ax.set_title(title, fontsize=9)
        ax.set_xlabel(across)
        ax.set_ylabel(up)
        ax.label_outer()
    set_signal_scale(axes[0, 0], np.concatenate([values.mean(axis=0), observed]))  # of all panels
    axes[0, 0].set_xlim(grid[0], grid[-1])
    for ax in axes.flat[len(data.panels) :]:
        ax.remove()
    handles = [Line2D([], [], color=colour, label=name) for colour, name in zip(colours, names, strict=True)]
    handles.append(Line2D([], [], color="0.4", lw=0.7, ls=_DASHES, label="single samples"))
    handles.append(Line2D([], [], color="black", lw=2.6, label="observation"))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 4))
    return figure


def _model_name(group: Group) -> str:
    """Return the mass of a node, or the ends of a range."""
    if group.low == group.high:
        return f"{group.low:g} keV" if np.isfinite(group.low) else "CDM"
    return f"{group.low:.1f} to {relic_name(group.high)}"


def tabulate(data: GroupedSummaries) -> pd.DataFrame:
    """Return means and single samples as they are drawn, and the observation."""
    grid, values = data.summaries.grids["correlation"], data.summaries.samples["correlation"]
    sample_id = data.summaries.parameters["sample_id"].to_numpy()

    def curve(c: FloatArray, name: str, **columns: float) -> pd.DataFrame:
        return pd.DataFrame({"dr_arcsec": grid, "c": c}).assign(curve=name, **columns)

    curves = [curve(data.summaries.observed["correlation"], "observation")]
    for panel in data.panels:
        ends = {"log10_m_halo_low_msun": panel.low, "log10_m_halo_high_msun": panel.high}
        for model, members in data.members(panel):
            group = data.models[model]
            where = {**ends, "m_th_low_kev": group.low, "m_th_high_kev": group.high, "n_samples": len(members)}
            curves.append(curve(values[members].mean(axis=0), "mean", **where))
            singles = members[:N_REALIZATIONS]
            curves += [curve(values[row], "sample", sample_id=sample_id[row], **where) for row in singles]
    return pd.concat(curves, ignore_index=True)
