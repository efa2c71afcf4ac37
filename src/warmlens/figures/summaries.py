"""Figures of the summaries: C(dr) and the cumulative distribution of samples and observation."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from warmlens.artifacts.file import ArtifactError, open_artifact
from warmlens.figures.draw.correlation import (
    SCATTER,
    draw_correlations,
    draw_cumulatives,
    group_by_mass,
    set_signal_scale,
)
from warmlens.figures.draw.halo_functions import model_colours
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.figures.inputs import Inputs
from warmlens.figures.recipe import all_of, needed, panel_table
from warmlens.figures.samples import Group, group_values, read_samples, relic_name
from warmlens.stages.summaries import COMBINED
from warmlens.types import FloatArray, IntArray

N_TERCILES = 3
N_PANELS, N_MODELS, N_REALIZATIONS = 4, 4, 4  # of a campaign without nodes; single samples drawn a model
_GRIDS = {"correlation": "separation", "cumulative": "thresholds"}
_COLUMNS = {"correlation": "dr_arcsec", "cumulative": "delta_r"}


@dataclass(frozen=True)
class SummariesFigure:
    """Summaries of all bands together.

    Attributes
    ----------
    grids, samples, observed
        By kind: separations [arcsec] or values of Delta R [n_grid], of the samples [n, n_grid], observed [n_grid].
    sample_id, m_th_kev, log10_m_halo_msun
        Samples that have not failed, each [n].
    """

    grids: dict[str, FloatArray]
    samples: dict[str, FloatArray]
    observed: dict[str, FloatArray]
    sample_id: IntArray
    m_th_kev: FloatArray
    log10_m_halo_msun: FloatArray

    def table(self) -> pd.DataFrame:
        """Mean and 16th to 84th percentile of each group in m_TH, and the observation."""
        panels = {}
        for kind, grid in self.grids.items():
            rows = [pd.DataFrame({_COLUMNS[kind]: grid, "group": "observation", "mean": self.observed[kind]})]
            for members in group_by_mass(self.m_th_kev, N_TERCILES):
                values = self.samples[kind][members]
                low, high = np.percentile(values, SCATTER, axis=0)
                masses = self.m_th_kev[members]
                columns = {_COLUMNS[kind]: grid, "mean": values.mean(axis=0), "p16": low, "p84": high}
                ends = {"m_th_low_kev": masses.min(), "m_th_high_kev": masses.max(), "n_samples": len(members)}
                rows.append(pd.DataFrame(columns).assign(group="samples", **ends))
            panels[kind] = pd.concat(rows, ignore_index=True)
        return panel_table(panels)


def read_summaries(inputs: Inputs) -> SummariesFigure:
    """C(dr) and cumulative distribution of all samples, and of the observation."""
    with open_artifact(needed(inputs, "observed_summary"), "observed_summary") as artifact:
        grids = {kind: artifact.array(name) for kind, name in _GRIDS.items()}
        observed = {kind: artifact.array(f"{COMBINED}/{kind}") for kind in _GRIDS}
    tables, values = [], []
    for path in all_of(inputs, "summaries"):
        with open_artifact(path, "summaries") as artifact:
            table = read_samples(artifact)
            rows = table["row"].to_numpy()
            tables.append(table)
            values.append({kind: artifact.array(f"{COMBINED}/{kind}")[rows] for kind in _GRIDS})
    every = pd.concat(tables, ignore_index=True)
    if len(every) < N_TERCILES:
        raise ArtifactError(f"{len(every)} samples are left, fewer than {N_TERCILES}: too few to be grouped")
    return SummariesFigure(
        grids=grids,
        samples={kind: np.concatenate([part[kind] for part in values]) for kind in _GRIDS},
        observed=observed,
        sample_id=every["sample_id"].to_numpy(),
        m_th_kev=every["m_th_kev"].to_numpy(),
        log10_m_halo_msun=every["log10_m_halo_msun"].to_numpy(),
    )


def draw_summaries(data: SummariesFigure) -> Figure:
    """C(dr) beside the cumulative distribution."""
    figure, axes = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, 3.2))
    for ax, draw, kind in zip(axes, (draw_correlations, draw_cumulatives), _GRIDS, strict=True):
        draw(ax, data.grids[kind], data.samples[kind], data.m_th_kev, data.observed[kind], N_TERCILES)
    return figure


@dataclass(frozen=True)
class HaloPanel:
    """Samples of one range of halo mass.

    Attributes
    ----------
    halos
        The range, and which samples lie in it.
    models
        Indices of the models of the figure, and which samples of this panel are of each.
    """

    halos: Group
    models: tuple[tuple[int, IntArray], ...]


@dataclass(frozen=True)
class PaperCorrelations:
    """Fig. 4 of the paper.

    Attributes
    ----------
    summaries
        Of all samples.
    panels
        One a range, or node, of halo mass, rising.
    models
        Ranges, or nodes, of thermal relic mass, rising.
    """

    summaries: SummariesFigure
    panels: tuple[HaloPanel, ...]
    models: tuple[Group, ...]

    def table(self) -> pd.DataFrame:
        """Means and single samples as they are drawn, and the observation."""
        grid, values = self.summaries.grids["correlation"], self.summaries.samples["correlation"]
        observed = pd.DataFrame({"dr_arcsec": grid, "c": self.summaries.observed["correlation"]})
        rows = [observed.assign(curve="observation")]
        for panel in self.panels:
            ends = {"log10_m_halo_low_msun": panel.halos.low, "log10_m_halo_high_msun": panel.halos.high}
            for model, members in panel.models:
                group = self.models[model]
                where = {**ends, "m_th_low_kev": group.low, "m_th_high_kev": group.high, "n_samples": len(members)}
                mean = pd.DataFrame({"dr_arcsec": grid, "c": values[members].mean(axis=0)})
                rows.append(mean.assign(curve="mean", **where))
                for member in members[:N_REALIZATIONS]:
                    single = pd.DataFrame({"dr_arcsec": grid, "c": values[member]})
                    rows.append(single.assign(curve="sample", sample_id=self.summaries.sample_id[member], **where))
        return pd.concat(rows, ignore_index=True)


def read_paper_correlations(inputs: Inputs) -> PaperCorrelations:
    """C(dr) by halo mass and model."""
    return group_samples(read_summaries(inputs))


def group_samples(data: SummariesFigure) -> PaperCorrelations:
    """Samples by halo mass and model: the nodes of a grid, else ranges of equal numbers of samples."""
    models = group_values(data.m_th_kev, min(N_MODELS, len(data.m_th_kev)))
    panels = []
    for halos in group_values(data.log10_m_halo_msun, min(N_PANELS, len(data.m_th_kev))):
        members = [(number, np.intersect1d(halos.rows, model.rows)) for number, model in enumerate(models)]
        panels.append(HaloPanel(halos, tuple((number, rows) for number, rows in members if rows.size)))
    return PaperCorrelations(data, tuple(panels), tuple(models))


def draw_paper_correlations(data: PaperCorrelations) -> Figure:
    """One panel a halo mass, one colour a model: means, some single samples dashed, the observation in black."""
    grid, values = data.summaries.grids["correlation"], data.summaries.samples["correlation"]
    observed = data.summaries.observed["correlation"]
    n_columns = 2 if len(data.panels) > 1 else 1
    n_rows = -(-len(data.panels) // n_columns)
    figure, axes = plt.subplots(
        n_rows,
        n_columns,
        figsize=(FULL_WIDTH_INCH, 0.5 + 2.5 * n_rows),
        sharex=True,
        sharey=True,
        squeeze=False,
    )
    names = [_model_name(group) for group in data.models]
    colours = list(model_colours(names).values())
    for ax, panel in zip(axes.flat, data.panels, strict=False):
        for model, members in panel.models:
            for member in members[:N_REALIZATIONS]:
                ax.plot(grid, values[member], color=colours[model], lw=0.5, ls=(0, (4, 2)), alpha=0.7)
            ax.plot(grid, values[members].mean(axis=0), color=colours[model])
        ax.plot(grid, observed, color="black", lw=2.6, zorder=5)
        n_samples = len(panel.halos.rows)
        halos = rf"$\log_{{10}}(M_{{\rm h}}/{{\rm M}}_\odot)$ = {_halo_name(panel.halos)}"
        ax.set_title(f"{halos}, {n_samples} samples", fontsize=9)
        ax.set_xlabel(r"${\rm d}r$ [arcsec]")
        ax.set_ylabel(r"$C({\rm d}r)$")
        ax.label_outer()
    set_signal_scale(axes[0, 0], np.concatenate([values.mean(axis=0), observed]))  # of all panels
    axes[0, 0].set_xlim(grid[0], grid[-1])
    for ax in axes.flat[len(data.panels) :]:
        ax.remove()
    handles = [Line2D([], [], color=colour, label=name) for colour, name in zip(colours, names, strict=True)]
    handles.append(Line2D([], [], color="0.4", lw=0.7, ls=(0, (4, 2)), label="single samples"))
    handles.append(Line2D([], [], color="black", lw=2.6, label="observation"))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 4))
    return figure


def _model_name(group: Group) -> str:
    """A node by its mass, a range by its ends."""
    if group.low == group.high:
        return f"{group.low:g} keV" if np.isfinite(group.low) else "CDM"
    return f"{group.low:.1f} to {relic_name(group.high)}"


def _halo_name(group: Group) -> str:
    return f"{group.low:g}" if group.low == group.high else f"{group.low:.2f} to {group.high:.2f}"
