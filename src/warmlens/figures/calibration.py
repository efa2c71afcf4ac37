"""Figure of the leave-one-out calibration: coverage, ranks, and the bounds of the trials."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from warmlens.artifacts.file import open_artifact
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.figures.inputs import Inputs
from warmlens.figures.recipe import needed, panel_table
from warmlens.inference.bound import LEVELS
from warmlens.inference.calibration import MASS_BINS_KEV
from warmlens.types import FloatArray, IntArray

Quantiles = tuple[float, float, float]
COLOUR, SECOND_COLOUR, MISSED_COLOUR = "#1f5f8b", "#d99a2b", "#c1403d"
_PARAMETERS = {"m_th_kev": r"$m_{\rm TH}$", "log10_m_halo_msun": r"$M_{\rm h}$"}


@dataclass(frozen=True)
class CalibrationFigure:
    """Coverage by true mass, rank tests, and trials.

    Attributes
    ----------
    coverage
        A row of counts, fraction, Clopper-Pearson interval and nominal value for all trials and each mass bin.
    ranks
        By parameter: rank, ECDF, lower and upper edge of its band [4, n_points].
    sample_id, truth_kev, bound_kev
        Of the trials, each [n_trials].
    observed_kev
        The bound of the observation [keV].
    expected_kev
        16, 50 and 84% quantiles of the bounds of cold truths [keV]; None if there are too few.
    null_kev
        The same of mocks without substructure [keV]; None without a null test.
    """

    coverage: pd.DataFrame
    ranks: dict[str, FloatArray]
    sample_id: IntArray
    truth_kev: FloatArray
    bound_kev: FloatArray
    observed_kev: float
    expected_kev: Quantiles | None
    null_kev: Quantiles | None = None

    def table(self) -> pd.DataFrame:
        """What the three panels show, one below the other."""
        panels = {"coverage": self.coverage}
        for name, (rank, *curves) in self.ranks.items():
            ecdf, low, high = (curve - rank for curve in curves)
            columns = {"rank": rank, "ecdf_minus_rank": ecdf, "band_low": low, "band_high": high}
            panels[f"ranks of {name}"] = pd.DataFrame(columns)
        panels["trials"] = pd.DataFrame(
            {"sample_id": self.sample_id, "true_m_th_kev": self.truth_kev, "bound_kev": self.bound_kev}
        )
        panels["observation"] = pd.DataFrame({"bound_kev": [self.observed_kev]})
        for name, values in (("expected of cold truths", self.expected_kev), ("null test", self.null_kev)):
            if values is not None:
                panels[name] = pd.DataFrame({"quantile": [0.16, 0.5, 0.84], "bound_kev": values})
        return panel_table(panels)


def read_calibration(inputs: Inputs) -> CalibrationFigure:
    """Calibration of the headline bound."""
    with open_artifact(needed(inputs, "abc"), "abc") as artifact:
        meta = artifact.metadata
        ranks = {name: artifact.array(f"ranks/{name}") for name in _PARAMETERS}
        sample_id, truth = artifact.array("trials/sample_id"), artifact.array("trials/truth")[:, 0]
        bounds = artifact.array("trials/bounds")[:, list(LEVELS).index(meta["headline"])]
    found = meta["calibration"]
    by_mass = found["coverage_by_true_mass"]
    entries = {"all": found["coverage"][meta["headline"]], **{name: by_mass[name] for name in MASS_BINS_KEV}}
    rows = [{"true_m_th": name, **entry} for name, entry in entries.items()]
    expected, null = meta["expected_limit"], meta["null_test"]
    return CalibrationFigure(
        coverage=pd.DataFrame(rows).astype({"fraction": float}),
        ranks=ranks,
        sample_id=sample_id,
        truth_kev=truth,
        bound_kev=bounds,
        observed_kev=meta["bounds"][meta["headline"]]["value_kev"],
        expected_kev=None if expected is None else tuple(expected["quantiles_kev"][1:4]),
        null_kev=None if null is None else tuple(null["bound_kev"][name] for name in ("low", "median", "high")),
    )


def draw_calibration(data: CalibrationFigure) -> Figure:
    """Three panels: coverage, ranks, trials."""
    figure, axes = plt.subplots(1, 3, figsize=(FULL_WIDTH_INCH, 2.9))
    _draw_coverage(axes[0], data.coverage)
    _draw_ranks(axes[1], data.ranks)
    _draw_trials(axes[2], data)
    return figure


def _draw_coverage(ax: Axes, coverage: pd.DataFrame) -> None:
    """Measured coverage with its interval against the nominal one; bins without trials are left out."""
    shown = coverage[coverage["n"] > 0]
    places = np.arange(len(shown))
    fraction, low, high = (shown[name].to_numpy() for name in ("fraction", "low", "high"))
    ax.axhline(shown["nominal"].iloc[0], color="black", lw=1.0, ls="--", label="nominal")
    ax.errorbar(places, fraction, yerr=[fraction - low, high - fraction], fmt="o", ms=4, lw=1.2, color=COLOUR)
    labels = [
        f"{name.replace(' keV', '').replace(' to ', '–')}\n({n})"
        for name, n in zip(shown["true_m_th"], shown["n"], strict=True)
    ]
    ax.set_xticks(places, labels, fontsize=7.5)
    ax.tick_params(axis="x", which="both", bottom=False, top=False)
    ax.set_xlim(-0.6, len(shown) - 0.4)
    ax.set_ylim(max(0.0, min(0.8, low.min() - 0.05)), 1.02)
    ax.set_xlabel(r"true $m_{\rm TH}$ [keV] (trials)")
    ax.set_ylabel("coverage of the bound")
    _legend_above(ax)


def _draw_ranks(ax: Axes, ranks: dict[str, FloatArray]) -> None:
    """ECDF of the ranks less that of uniform ones, and the band that uniform ones stay within."""
    first = next(iter(ranks.values()))
    ax.fill_between(first[0], first[2] - first[0], first[3] - first[0], color="0.88", lw=0, label="95% band")
    ax.axhline(0.0, color="0.6", lw=0.8)
    for (name, (rank, ecdf, _, _)), colour in zip(ranks.items(), (COLOUR, SECOND_COLOUR), strict=True):
        ax.plot(rank, ecdf - rank, color=colour, drawstyle="steps-mid", lw=1.2, label=_PARAMETERS[name])
    reach = 1.15 * max(float(np.abs(values[1:] - values[0]).max()) for values in ranks.values())
    ax.set_ylim(-reach, reach)
    ax.set_xlim(0.0, 1.0)
    ax.set_xlabel("rank of the truth")
    ax.set_ylabel("ECDF $-$ uniform", labelpad=0.0)
    _legend_above(ax)


def _draw_trials(ax: Axes, data: CalibrationFigure) -> None:
    """Bound of every trial against its truth; above the diagonal the bound excludes the truth."""
    known = np.isfinite(data.bound_kev)
    truth, bound = data.truth_kev[known], data.bound_kev[known]
    missed = bound > truth
    size = float(np.clip(1500.0 / max(truth.size, 1), 1.5, 8.0))
    for quantiles, colour, label in (
        (data.expected_kev, "0.5", "expected for CDM"),
        (data.null_kev, SECOND_COLOUR, "no substructure"),
    ):
        if quantiles is not None:
            low, median, high = quantiles
            ax.axhspan(low, high, color=colour, alpha=0.25, lw=0, label=label)
            ax.axhline(median, color=colour, lw=0.8)
    for rows, colour, label in ((~missed, COLOUR, ""), (missed, MISSED_COLOUR, "excluded truth")):
        ax.scatter(truth[rows], bound[rows], s=size, color=colour, lw=0, alpha=0.7, label=label, rasterized=True)
    ends = float(truth.min()), float(truth.max())
    ax.plot(ends, ends, color="black", lw=0.8)
    ax.axhline(data.observed_kev, color="black", lw=1.0, ls="--", label="observed")
    span = ends[1] - ends[0]
    top = max(float(bound.max()), data.observed_kev, ends[0] + 0.35 * span)
    low = min(ends[0], float(bound.min()))
    ax.set_xlim(ends[0] - 0.02 * span, ends[1] + 0.02 * span)
    ax.set_ylim(low - 0.04 * (top - low), top + 0.04 * (top - low))
    ax.set_xlabel(r"true $m_{\rm TH}$ [keV]")
    ax.set_ylabel("bound [keV]")
    _legend_above(ax, 2)


def _legend_above(ax: Axes, n_columns: int = 3) -> None:
    ax.legend(
        loc="lower left",
        bbox_to_anchor=(-0.04, 0.99),
        ncols=n_columns,
        borderaxespad=0.1,
        handlelength=1.2,
        handletextpad=0.4,
        columnspacing=0.8,
        fontsize=7.5,
    )
