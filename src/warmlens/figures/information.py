"""Figure of what each set of summaries says about m_TH: information gain and bounds."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from warmlens.figures.draw.axes import BOUND_LABEL
from warmlens.figures.draw.style import BLUE, FULL_WIDTH_INCH, ORANGE
from warmlens.figures.inputs import Inputs, open_input
from warmlens.inference.summary_sets import SETS

_COLUMNS = {  # by key of the gain, and of the bound
    "gain_nats": "gain_nats",
    "gain_error_nats": "gain_error_nats",
    "value_kev": "bound_kev",
    "mc_error_kev": "bound_error_kev",
    "expected_bound_kev": "expected_kev",
    "expected_bound_error_kev": "expected_error_kev",
}


def read(inputs: Inputs) -> pd.DataFrame:
    """Return gain [nat] and bounds [keV] of every set; NaN where it was refused or too few truths are cold."""
    with open_input(inputs, "abc") as artifact:
        meta = artifact.metadata
    entries = [meta["summary_sets"][name] for name in SETS]
    numbers = pd.DataFrame([{} if "refused" in entry else entry["gain"] | entry["bound"] for entry in entries])
    sets = numbers.reindex(columns=list(_COLUMNS)).rename(columns=_COLUMNS).astype(float)
    sets.insert(0, "summaries", list(SETS))
    return sets.assign(prior_only_kev=meta["bounds"][meta["headline"]]["prior_only_kev"])


def draw(sets: pd.DataFrame) -> Figure:
    """Draw gain and bounds, one line per set."""
    places = np.arange(len(sets))
    figure, (left, right) = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, 1.2 + 0.3 * len(sets)), sharey=True)
    style = {"fmt": "o", "ms": 4, "lw": 1.2}
    left.axvline(0.0, color="0.6", lw=0.8)
    left.errorbar(sets["gain_nats"], places, xerr=sets["gain_error_nats"], color=BLUE, **style)
    for place in places[sets["gain_nats"].isna()]:
        left.text(0.0, place, " too few samples", va="center", fontsize=8, color="0.4")
    left.set_xlabel(r"information on $m_{\rm TH}$ [nat]")
    left.set_yticks(places, [name.replace("_", " ") for name in sets["summaries"]])
    for name, label, colour, shift in (
        ("bound", "of the observation", BLUE, -0.1),
        ("expected", "expected for CDM", ORANGE, 0.1),
    ):
        if sets[f"{name}_kev"].notna().any():
            values, errors = sets[f"{name}_kev"], sets[f"{name}_error_kev"]
            right.errorbar(values, places + shift, xerr=errors, color=colour, label=label, **style)
    right.axvline(sets["prior_only_kev"].iloc[0], color="black", lw=1.0, ls="--", label="prior alone")
    right.set_xlabel(BOUND_LABEL)
    left.set_ylim(len(sets) - 0.5, -0.5)
    for ax in (left, right):
        ax.tick_params(axis="y", which="both", left=False, right=False)
    figure.legend(*right.get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure
