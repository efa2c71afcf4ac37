"""Figure of the likelihood ratio B(m_TH), and of the bound at other levels, under other rules and priors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from warmlens.figures.draw.axes import BOUND_LABEL, MASS_LABEL, legend_above
from warmlens.figures.draw.style import BLUE, FULL_WIDTH_INCH, RED
from warmlens.figures.inputs import Inputs, open_input
from warmlens.inference.priors import HALO_MASS_PRIORS, MASS_PRIORS

_UNIFORM_IN = {
    "uniform_m": r"$m_{\rm TH}$",
    "uniform_log_m": r"log $m_{\rm TH}$",
    "uniform_inverse_m": r"$1/m_{\rm TH}$",
    "uniform_log_half_mode_mass": r"log $M_{\rm hm}$",
}
_MAX_OVER_PEAK = 10.0  # a band that reaches higher is cut off: few samples at the upper end of the prior


def read(inputs: Inputs) -> dict[str, pd.DataFrame]:
    """Return B(m) with its band, where it falls to 1/10 and 1/20, and the bounds, the headline first."""
    with open_input(inputs, "abc") as artifact:
        meta = artifact.metadata
        m_kev, ratio, band = (artifact.array(f"likelihood/{name}") for name in ("m_kev", "ratio", "band"))
    crossings = [
        {"b": crossing["ratio"], "m_th_kev": crossing["m_kev"], "mc_error_kev": crossing["mc_error_kev"]}
        for crossing in meta["likelihood_ratio"]["falls_to"].values()
    ]
    bounds = {"headline": meta["bounds"][meta["headline"]]}
    for name, bound in meta["bounds"].items():
        if name != meta["headline"]:
            bounds[f"level {100 * (1 - bound['level']):.4g}%"] = bound
    bounds |= {"rule: " + name.replace("_", " "): bound for name, bound in meta["other_rules"].items()}
    bounds |= {_prior_name(name): meta["other_priors"][name] for name in (*MASS_PRIORS, *HALO_MASS_PRIORS)}
    return {
        "likelihood ratio": pd.DataFrame({"m_th_kev": m_kev, "b": ratio, "b_p16": band[0], "b_p84": band[1]}),
        "crossing": pd.DataFrame(crossings).astype(float),
        "bound": _tabulate_bounds(bounds),
    }


def _tabulate_bounds(bounds: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Return bounds of `abc.json` by name [keV]; NaN where a rule or prior was refused."""
    keys = {"bound_kev": "value_kev", "mc_error_kev": "mc_error_kev", "prior_only_kev": "prior_only_kev"}
    numbers = {column: [bound.get(key) for bound in bounds.values()] for column, key in keys.items()}
    return pd.DataFrame({"name": list(bounds), **numbers}).astype(dict.fromkeys(keys, float))


def _prior_name(name: str) -> str:
    """Return the name of another prior, with its numbers if it is one of the halo mass."""
    if name in HALO_MASS_PRIORS:
        prior = HALO_MASS_PRIORS[name]
        kind = f"{prior.mean:g} to {prior.sigma:g}" if prior.flat else rf"{prior.mean:g} $\pm$ {prior.sigma:g}"
        return rf"prior: log $M_{{\rm h}}$ {kind}"
    return f"prior: uniform in {_UNIFORM_IN[name]}"


def draw(panels: dict[str, pd.DataFrame]) -> Figure:
    """Draw B(m) and the bounds."""
    bounds = panels["bound"]
    height = max(3.2, 0.9 + 0.19 * len(bounds))
    figure, axes = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, height), width_ratios=(1.25, 1.0))
    _draw_likelihood_ratio(axes[0], panels["likelihood ratio"], panels["crossing"])
    _draw_bounds(axes[1], bounds)
    return figure


def _draw_likelihood_ratio(ax: Axes, ratio: pd.DataFrame, crossings: pd.DataFrame) -> None:
    """Draw B(m) with its band, and where it falls to given values, on a logarithmic ordinate."""
    m_kev = ratio["m_th_kev"].to_numpy()
    floor = 0.5 * float(crossings["b"].min())
    b, low, high = (np.maximum(ratio[name], floor) for name in ("b", "b_p16", "b_p84"))
    ax.fill_between(m_kev, low, high, color=BLUE, alpha=0.2, lw=0)
    ax.plot(m_kev, b, color=BLUE, label=r"$B(m_{\rm TH})$, 16 to 84%")
    ax.axhline(1.0, color="0.6", lw=0.8)
    for value, mass, error in crossings.to_numpy():
        ax.axhline(value, color=RED, lw=0.8, ls="--")
        where = f"{mass:.2f}" + (rf" $\pm$ {error:.2f}" if np.isfinite(error) else "") + " keV"
        name = f"1/{1.0 / value:.3g}: " + (where if np.isfinite(mass) else "not reached")
        ax.text(m_kev[-1], 1.06 * value, name + " ", ha="right", va="bottom", fontsize=8, color=RED)
        if np.isfinite(mass):
            ax.errorbar(mass, value, xerr=np.nan_to_num(error), fmt="o", ms=4, lw=1.1, color=RED)
    ax.set_yscale("log")
    ax.set_xlim(m_kev[0], m_kev[-1])
    ax.set_ylim(floor, 1.6 * min(ratio["b_p84"].max(), _MAX_OVER_PEAK * max(1.0, ratio["b"].max())))
    ax.set_xlabel(MASS_LABEL, fontsize=mpl.rcParams["axes.labelsize"])
    ax.set_ylabel(r"$B(m_{\rm TH})$ over its value at " + f"{m_kev[-1]:g} keV")
    legend_above(ax)


def _draw_bounds(ax: Axes, bounds: pd.DataFrame) -> None:
    """Draw one bound per line, the headline on top with a band of its error through all lines.

    A short bar marks what the prior of the line alone gives; a line without a bound says so.
    """
    places = np.arange(len(bounds))
    values, errors, priors = (bounds[name].to_numpy() for name in ("bound_kev", "mc_error_kev", "prior_only_kev"))
    ax.axvspan(values[0] - errors[0], values[0] + errors[0], color=RED, alpha=0.12, lw=0)
    for lines, colour, label in ((slice(0, 1), RED, None), (slice(1, None), BLUE, "bound")):
        bars = {"xerr": np.nan_to_num(errors[lines]), "fmt": "o", "ms": 3.5, "lw": 1.1}
        ax.errorbar(values[lines], places[lines], color=colour, label=label, **bars)
    ax.plot(priors, places, ls="", marker="|", ms=8, mew=1.1, color="black", label="prior alone")
    centre = float(np.nanmean(np.concatenate([values, priors])))
    for place in places[np.isnan(values)]:
        ax.text(centre, place, "none", ha="center", va="center", fontsize=7.5, color="0.4")
    ax.set_yticks(places, bounds["name"], fontsize=7.5)
    ax.tick_params(axis="y", which="both", left=False, right=False)
    ax.minorticks_off()
    ax.set_ylim(len(bounds) - 0.4, -0.6)
    ax.set_xlabel(BOUND_LABEL)
    legend_above(ax, 2)
