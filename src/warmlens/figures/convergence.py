"""Figure of the bound at falling fractions of accepted samples."""

from __future__ import annotations

import matplotlib.pyplot as plt
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, ScalarFormatter

from warmlens.figures.draw.axes import BOUND_LABEL
from warmlens.figures.draw.style import BLUE, ORANGE, SINGLE_COLUMN_INCH
from warmlens.figures.inputs import Inputs, open_input


def read(inputs: Inputs) -> pd.DataFrame:
    """Return raw and adjusted bound at each fraction [keV], NaN where there is no adjustment.

    `of_the_inference` is 1 at the fraction of the inference; `verdict` is that of the raw bound.
    """
    with open_input(inputs, "abc") as artifact:
        meta = artifact.metadata
    steps = pd.DataFrame(meta["threshold_convergence"]["steps"]).astype(float).astype({"k": int})
    return steps.assign(
        of_the_inference=(steps["fraction"] == meta["fraction"]).astype(int),
        prior_only_kev=meta["bounds"][meta["headline"]]["prior_only_kev"],
        verdict=meta["threshold_convergence"]["raw"],
    )


def draw(steps: pd.DataFrame) -> Figure:
    """Draw raw and adjusted bound with errors, stricter thresholds to the right."""
    figure, ax = plt.subplots(figsize=(SINGLE_COLUMN_INCH, 3.0))
    for fraction in steps["fraction"][steps["of_the_inference"] == 1]:
        ax.axvline(fraction, color="0.6", lw=0.8, ls="--")
    ax.axhline(steps["prior_only_kev"].iloc[0], color="black", lw=1.0, ls="--", label="prior alone")
    for name, colour, shift in (("raw", BLUE, 1.0), ("adjusted", ORANGE, 1.06)):
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
    ax.set_ylabel(BOUND_LABEL)
    title = f"threshold: {steps['verdict'].iloc[0]}"
    handles, names = ax.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, title=title, title_fontsize=8.5)
    return figure


def tabulate(steps: pd.DataFrame) -> pd.DataFrame:
    """Return the steps without the verdict."""
    return steps.drop(columns="verdict")
