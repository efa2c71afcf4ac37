"""Figures that check the inference: convergence in the threshold, predictive check, worth of the summaries."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, ScalarFormatter

from warmlens.artifacts.file import open_artifact
from warmlens.figures.draw.correlation import set_signal_scale
from warmlens.figures.draw.style import FULL_WIDTH_INCH, SINGLE_COLUMN_INCH
from warmlens.figures.inputs import Inputs
from warmlens.figures.recipe import needed, panel_table
from warmlens.inference.summary_sets import SETS
from warmlens.stages.summaries import COMBINED
from warmlens.types import FloatArray

RAW_COLOUR, ADJUSTED_COLOUR = "#1f5f8b", "#d99a2b"
_GRIDS = {"correlation": ("separation", "dr_arcsec"), "cumulative": ("thresholds", "delta_r")}
_LEVELS = ("p025", "p16", "p50", "p84", "p975")


@dataclass(frozen=True)
class ConvergenceFigure:
    """The bound at falling accepted fractions.

    Attributes
    ----------
    steps
        fraction, k, raw_kev, raw_error_kev, adjusted_kev, adjusted_error_kev; NaN where there is no adjustment.
    fraction
        Of the inference.
    prior_only_kev
        What the prior alone gives [keV].
    verdict
        Of the raw bound.
    """

    steps: pd.DataFrame
    fraction: float
    prior_only_kev: float
    verdict: str

    def table(self) -> pd.DataFrame:
        """The steps, and whether each is that of the inference."""
        return self.steps.assign(
            of_the_inference=(self.steps["fraction"] == self.fraction).astype(int),
            prior_only_kev=self.prior_only_kev,
        )


def read_convergence(inputs: Inputs) -> ConvergenceFigure:
    """Bound against accepted fraction."""
    with open_artifact(needed(inputs, "abc"), "abc") as artifact:
        meta = artifact.metadata
    found = meta["threshold_convergence"]
    return ConvergenceFigure(
        steps=pd.DataFrame(found["steps"]).astype(float).astype({"k": int}),
        fraction=meta["fraction"],
        prior_only_kev=meta["bounds"][meta["headline"]]["prior_only_kev"],
        verdict=found["raw"],
    )


def draw_convergence(data: ConvergenceFigure) -> Figure:
    """Raw and adjusted bound with errors, stricter thresholds to the right."""
    figure, ax = plt.subplots(figsize=(SINGLE_COLUMN_INCH, 3.0))
    steps = data.steps
    ax.axvline(data.fraction, color="0.6", lw=0.8, ls="--")
    ax.axhline(data.prior_only_kev, color="black", lw=1.0, ls="--", label="prior alone")
    for name, colour, shift in (("raw", RAW_COLOUR, 1.0), ("adjusted", ADJUSTED_COLOUR, 1.06)):
        some = steps[steps[f"{name}_kev"].notna()]
        if some.empty:
            continue
        errors = some[f"{name}_error_kev"].to_numpy()
        ax.errorbar(
            some["fraction"] * shift, some[f"{name}_kev"], errors, fmt="o-", ms=4, lw=1.1, color=colour, label=name
        )
    ax.set_xscale("log")
    ax.set_xlim(1.35 * steps["fraction"].max(), steps["fraction"].min() / 1.35)
    ax.set_xticks(steps["fraction"], [f"{100 * value:g}" for value in steps["fraction"]])
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.yaxis.set_major_formatter(ScalarFormatter())
    top = ax.secondary_xaxis("top")
    top.set_xticks(steps["fraction"], [str(value) for value in steps["k"]])
    top.minorticks_off()
    ax.tick_params(axis="x", which="both", top=False)
    ax.minorticks_off()
    top.set_xlabel("accepted samples")
    ax.set_xlabel("accepted fraction [%]")
    ax.set_ylabel(r"lower bound on $m_{\rm TH}$ [keV]")
    handles, names = ax.get_legend_handles_labels()
    figure.legend(
        handles, names, loc="outside lower center", ncols=3, title=f"threshold: {data.verdict}", title_fontsize=8.5
    )
    return figure


@dataclass(frozen=True)
class PredictiveFigure:
    """Summaries of the accepted samples over the observed ones.

    Attributes
    ----------
    grids, quantiles, observed
        By kind: grid [n], 2.5, 16, 50, 84 and 97.5% of the accepted samples [5, n], the observation [n].
    p_values
        By kind: posterior predictive p.
    """

    grids: dict[str, FloatArray]
    quantiles: dict[str, FloatArray]
    observed: dict[str, FloatArray]
    p_values: dict[str, float]

    def table(self) -> pd.DataFrame:
        """Quantiles and observation of both kinds, one below the other."""
        panels = {}
        for kind, (_, column) in _GRIDS.items():
            levels = dict(zip(_LEVELS, self.quantiles[kind], strict=True))
            columns = {column: self.grids[kind], "observed": self.observed[kind], **levels}
            panels[kind] = pd.DataFrame(columns).assign(p_value=self.p_values[kind])
        return panel_table(panels)


def read_predictive(inputs: Inputs) -> PredictiveFigure:
    """C(dr) and cumulative distribution of the accepted samples and of the observation."""
    with open_artifact(needed(inputs, "observed_summary"), "observed_summary") as artifact:
        grids = {kind: artifact.array(name) for kind, (name, _) in _GRIDS.items()}
        observed = {kind: artifact.array(f"{COMBINED}/{kind}") for kind in _GRIDS}
    with open_artifact(needed(inputs, "abc"), "abc") as artifact:
        quantiles = {kind: artifact.array(f"predictive/{kind}/quantiles") for kind in _GRIDS}
        p_values = artifact.metadata["posterior_predictive_p"]
    return PredictiveFigure(grids, quantiles, observed, {kind: p_values[kind] for kind in _GRIDS})


def draw_predictive(data: PredictiveFigure) -> Figure:
    """C(dr) beside the cumulative distribution."""
    figure, axes = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, 3.1))
    for ax, kind in zip(axes, _GRIDS, strict=True):
        grid, (p025, p16, p50, p84, p975) = data.grids[kind], data.quantiles[kind]
        ax.fill_between(grid, p025, p975, color=RAW_COLOUR, alpha=0.18, lw=0, label="accepted, 95%")
        ax.fill_between(grid, p16, p84, color=RAW_COLOUR, alpha=0.35, lw=0, label="68%")
        ax.plot(grid, p50, color=RAW_COLOUR, label="median")
        ax.plot(grid, data.observed[kind], color="black", lw=2.2, label="observation")
        set_signal_scale(ax, np.concatenate([p84, data.observed[kind]]))
        ax.set_xlim(grid[0], grid[-1])
        ax.set_title(f"posterior predictive $p$ = {data.p_values[kind]:.2f}", fontsize=9)
    axes[0].set_xlabel(r"${\rm d}r$ [arcsec]")
    axes[0].set_ylabel(r"$C({\rm d}r)$")
    axes[1].set_xlabel(r"$\Delta R$")
    axes[1].set_ylabel(r"fraction of positions below $\Delta R$")
    axes[0].legend(loc="upper right")
    return figure


@dataclass(frozen=True)
class InformationFigure:
    """Worth of each set of summaries.

    Attributes
    ----------
    sets
        summaries, gain_nats, gain_error_nats, bound_kev, bound_error_kev, expected_kev, expected_error_kev; NaN
        where the set was refused or too few cold truths are there.
    prior_only_kev
        What the prior alone gives [keV].
    """

    sets: pd.DataFrame
    prior_only_kev: float

    def table(self) -> pd.DataFrame:
        """A row a set."""
        return self.sets.assign(prior_only_kev=self.prior_only_kev)


def read_information(inputs: Inputs) -> InformationFigure:
    """Information gain and bounds of every set of summaries."""
    with open_artifact(needed(inputs, "abc"), "abc") as artifact:
        meta = artifact.metadata
    rows = []
    for name in SETS:
        entry = meta["summary_sets"][name]
        gain, bound = (entry[key] if "refused" not in entry else {} for key in ("gain", "bound"))
        rows.append(
            {
                "summaries": name,
                "gain_nats": gain.get("gain_nats"),
                "gain_error_nats": gain.get("gain_error_nats"),
                "bound_kev": bound.get("value_kev"),
                "bound_error_kev": bound.get("mc_error_kev"),
                "expected_kev": gain.get("expected_bound_kev"),
                "expected_error_kev": gain.get("expected_bound_error_kev"),
            }
        )
    numbers = dict.fromkeys([name for name in rows[0] if name != "summaries"], float)
    prior_only = meta["bounds"][meta["headline"]]["prior_only_kev"]
    return InformationFigure(pd.DataFrame(rows).astype(numbers), prior_only)


def draw_information(data: InformationFigure) -> Figure:
    """Gain beside bounds, a line a set."""
    sets, places = data.sets, np.arange(len(data.sets))
    figure, (left, right) = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, 1.2 + 0.3 * len(sets)), sharey=True)
    style = {"fmt": "o", "ms": 4, "lw": 1.2}
    left.axvline(0.0, color="0.6", lw=0.8)
    left.errorbar(sets["gain_nats"], places, xerr=sets["gain_error_nats"], color=RAW_COLOUR, **style)
    for place in places[sets["gain_nats"].isna()]:
        left.text(0.0, place, " too few samples", va="center", fontsize=8, color="0.4")
    left.set_xlabel(r"information on $m_{\rm TH}$ [nat]")
    left.set_yticks(places, [name.replace("_", " ") for name in sets["summaries"]])
    for name, label, colour, shift in (
        ("bound", "of the observation", RAW_COLOUR, -0.1),
        ("expected", "expected for CDM", ADJUSTED_COLOUR, 0.1),
    ):
        if sets[f"{name}_kev"].notna().any():
            values, errors = sets[f"{name}_kev"], sets[f"{name}_error_kev"]
            right.errorbar(values, places + shift, xerr=errors, color=colour, label=label, **style)
    right.axvline(data.prior_only_kev, color="black", lw=1.0, ls="--", label="prior alone")
    right.set_xlabel(r"lower bound on $m_{\rm TH}$ [keV]")
    left.set_ylim(len(sets) - 0.5, -0.5)
    for ax in (left, right):
        ax.tick_params(axis="y", which="both", left=False, right=False)
    figure.legend(*right.get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure
