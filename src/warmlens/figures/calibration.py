"""Figure of the leave-one-out calibration: coverage, ranks, and the bounds of the trials."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from warmlens.figures.draw.axes import legend_above
from warmlens.figures.draw.style import BLUE, FULL_WIDTH_INCH, ORANGE, RED
from warmlens.figures.inputs import Inputs, open_input
from warmlens.inference.bound import LEVELS
from warmlens.inference.calibration import MASS_BINS_KEV

_PARAMETERS = {"m_th_kev": r"$m_{\rm TH}$", "log10_m_halo_msun": r"$M_{\rm h}$"}
_EXPECTED, _NULL = "expected of cold truths", "null test"
_LEGEND: dict[str, Any] = {"handlelength": 1.2, "handletextpad": 0.4, "columnspacing": 0.8, "fontsize": 7.5}


def read(inputs: Inputs) -> dict[str, pd.DataFrame]:
    """Return the calibration of the headline bound.

    coverage
        Counts, fraction, Clopper-Pearson interval and nominal value for all trials and each bin of true m_TH.
    ranks of (each parameter)
        ECDF of the rank of the truth, and the band that uniform ranks stay within, less the uniform ECDF.
    trials, observation
        Truth and bound [keV] of each trial, and the bound of the observation.
    expected of cold truths, null test
        16, 50 and 84% quantiles of the bounds [keV] of cold truths and of mocks without substructure; left out
        if there are too few, or without a null test.
    """
    with open_input(inputs, "abc") as artifact:
        meta = artifact.metadata
        ranks = {name: artifact.array(f"ranks/{name}") for name in _PARAMETERS}
        trials = {
            "sample_id": artifact.array("trials/sample_id"),
            "true_m_th_kev": artifact.array("trials/truth")[:, 0],
            "bound_kev": artifact.array("trials/bounds")[:, list(LEVELS).index(meta["headline"])],
        }
    measured = meta["calibration"]
    by_mass = measured["coverage_by_true_mass"]
    coverage = {"all": measured["coverage"][meta["headline"]], **{name: by_mass[name] for name in MASS_BINS_KEV}}
    rows = [{"true_m_th": name, **entry} for name, entry in coverage.items()]
    panels = {"coverage": pd.DataFrame(rows).astype({"fraction": float})}
    for name, (rank, *curves) in ranks.items():
        ecdf, low, high = (curve - rank for curve in curves)
        columns = {"rank": rank, "ecdf_minus_rank": ecdf, "band_low": low, "band_high": high}
        panels[f"ranks of {name}"] = pd.DataFrame(columns)
    panels["trials"] = pd.DataFrame(trials)
    panels["observation"] = pd.DataFrame({"bound_kev": [meta["bounds"][meta["headline"]]["value_kev"]]})
    quantiles = {}
    if meta["expected_limit"] is not None:
        quantiles[_EXPECTED] = meta["expected_limit"]["quantiles_kev"][1:4]
    if meta["null_test"] is not None:
        quantiles[_NULL] = [meta["null_test"]["bound_kev"][name] for name in ("low", "median", "high")]
    for name, values in quantiles.items():
        panels[name] = pd.DataFrame({"quantile": [0.16, 0.5, 0.84], "bound_kev": values})
    return panels


def draw(panels: dict[str, pd.DataFrame]) -> Figure:
    """Draw coverage, ranks and trials."""
    figure, axes = plt.subplots(1, 3, figsize=(FULL_WIDTH_INCH, 2.9))
    _draw_coverage(axes[0], panels["coverage"])
    _draw_ranks(axes[1], panels)
    _draw_trials(axes[2], panels)
    for ax, n_columns in zip(axes, (3, 3, 2), strict=True):
        legend_above(ax, n_columns, (-0.04, 0.99), **_LEGEND)
    return figure


def _draw_coverage(ax: Axes, coverage: pd.DataFrame) -> None:
    """Draw the measured coverage with its interval, and the nominal one; bins without trials are left out."""
    shown = coverage[coverage["n"] > 0]
    places = np.arange(len(shown))
    fraction, low, high = (shown[name].to_numpy() for name in ("fraction", "low", "high"))
    ax.axhline(shown["nominal"].iloc[0], color="black", lw=1.0, ls="--", label="nominal")
    ax.errorbar(places, fraction, yerr=[fraction - low, high - fraction], fmt="o", ms=4, lw=1.2, color=BLUE)
    names = shown["true_m_th"].str.replace(" keV", "").str.replace(" to ", "–")
    labels = [f"{name}\n({n})" for name, n in zip(names, shown["n"], strict=True)]
    ax.set_xticks(places, labels, fontsize=7.5)
    ax.tick_params(axis="x", which="both", bottom=False, top=False)
    ax.set_xlim(-0.6, len(shown) - 0.4)
    ax.set_ylim(max(0.0, min(0.8, low.min() - 0.05)), 1.02)
    ax.set_xlabel(r"true $m_{\rm TH}$ [keV] (trials)")
    ax.set_ylabel("coverage of the bound")


def _draw_ranks(ax: Axes, panels: dict[str, pd.DataFrame]) -> None:
    """Draw the ECDF of the ranks less that of uniform ones, and the band that uniform ones stay within."""
    ranks = {label: panels[f"ranks of {name}"] for name, label in _PARAMETERS.items()}
    first = next(iter(ranks.values()))
    ax.fill_between(first["rank"], first["band_low"], first["band_high"], color="0.88", lw=0, label="95% band")
    ax.axhline(0.0, color="0.6", lw=0.8)
    for (label, curve), colour in zip(ranks.items(), (BLUE, ORANGE), strict=True):
        ax.plot(curve["rank"], curve["ecdf_minus_rank"], color=colour, drawstyle="steps-mid", lw=1.2, label=label)
    reach = 1.15 * max(float(curve.drop(columns="rank").abs().to_numpy().max()) for curve in ranks.values())
    ax.set_ylim(-reach, reach)
    ax.set_xlim(0.0, 1.0)
    ax.set_xlabel("rank of the truth")
    ax.set_ylabel("ECDF $-$ uniform", labelpad=0.0)


def _draw_trials(ax: Axes, panels: dict[str, pd.DataFrame]) -> None:
    """Draw the bound of every trial against its truth; above the diagonal the bound excludes the truth."""
    trials = panels["trials"][np.isfinite(panels["trials"]["bound_kev"])]
    truth, bound = trials["true_m_th_kev"].to_numpy(), trials["bound_kev"].to_numpy()
    observed = float(panels["observation"]["bound_kev"].item())
    missed = bound > truth
    size = float(np.clip(1500.0 / max(truth.size, 1), 1.5, 8.0))
    for name, colour, label in ((_EXPECTED, "0.5", "expected for CDM"), (_NULL, ORANGE, "no substructure")):
        if name in panels:
            low, median, high = panels[name]["bound_kev"]
            ax.axhspan(low, high, color=colour, alpha=0.25, lw=0, label=label)
            ax.axhline(median, color=colour, lw=0.8)
    for rows, colour, label in ((~missed, BLUE, ""), (missed, RED, "excluded truth")):
        ax.scatter(truth[rows], bound[rows], s=size, color=colour, lw=0, alpha=0.7, label=label, rasterized=True)
    ends = float(truth.min()), float(truth.max())
    ax.plot(ends, ends, color="black", lw=0.8)
    ax.axhline(observed, color="black", lw=1.0, ls="--", label="observed")
    span = ends[1] - ends[0]
    top = max(float(bound.max()), observed, ends[0] + 0.35 * span)
    low = min(ends[0], float(bound.min()))
    ax.set_xlim(ends[0] - 0.02 * span, ends[1] + 0.02 * span)
    ax.set_ylim(low - 0.04 * (top - low), top + 0.04 * (top - low))
    ax.set_xlabel(r"true $m_{\rm TH}$ [keV]")
    ax.set_ylabel("bound [keV]")
