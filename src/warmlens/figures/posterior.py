"""Figures of the posterior: accepted samples, marginal, likelihood ratio, and the bound told otherwise."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from warmlens.artifacts.file import open_artifact
from warmlens.figures.draw.bounds import BoundRow, draw_bound_rows
from warmlens.figures.draw.likelihood import draw_likelihood_ratio
from warmlens.figures.draw.posterior import draw_mass_marginal, draw_posterior_plane
from warmlens.figures.draw.style import FULL_WIDTH_INCH
from warmlens.figures.inputs import Inputs
from warmlens.figures.recipe import needed, panel_table
from warmlens.inference.bound import Bound
from warmlens.inference.priors import HALO_MASS_PRIORS, MASS_PRIORS
from warmlens.types import BoolArray, FloatArray, IntArray

_UNIFORM_IN = {
    "uniform_m": r"$m_{\rm TH}$",
    "uniform_log_m": r"log $m_{\rm TH}$",
    "uniform_inverse_m": r"$1/m_{\rm TH}$",
    "uniform_log_half_mode_mass": r"log $M_{\rm hm}$",
}


@dataclass(frozen=True)
class PosteriorFigure:
    """Samples and bound.

    Attributes
    ----------
    sample_id, m_th_kev, log10_m_halo_msun, accepted
        Of all samples that have not failed, each [n].
    bound
        The headline.
    m_range_kev, halo_range
        Edges of the prior.
    """

    sample_id: IntArray
    m_th_kev: FloatArray
    log10_m_halo_msun: FloatArray
    accepted: BoolArray
    bound: Bound
    m_range_kev: tuple[float, float]
    halo_range: tuple[float, float]

    def table(self) -> pd.DataFrame:
        """The samples, and the bound in a row of its own."""
        samples = {
            "sample_id": self.sample_id,
            "m_th_kev": self.m_th_kev,
            "log10_m_halo_msun": self.log10_m_halo_msun,
            "accepted": self.accepted.astype(int),
        }
        bound = {
            "level": [self.bound.level],
            "bound_kev": [self.bound.value_kev],
            "mc_error_kev": [self.bound.mc_error_kev],
            "prior_only_kev": [self.bound.prior_only_kev],
        }
        return panel_table({"samples": pd.DataFrame(samples), "bound": pd.DataFrame(bound)})


def read_posterior(inputs: Inputs) -> PosteriorFigure:
    """All samples, which are accepted, and the headline bound."""
    with open_artifact(needed(inputs, "abc"), "abc") as artifact:
        prior = artifact.settings["dark_matter"]
        meta = artifact.metadata
        good = artifact.array("table/status") == 0
        columns = {
            name: artifact.array(f"table/{name}")[good] for name in ("sample_id", "m_th_kev", "log10_m_halo_msun")
        }
        accepted = artifact.array("table/accepted").astype(bool)[good]
    headline = meta["bounds"][meta["headline"]]
    low, high = prior["m_th_kev"]
    halo_low, halo_high = prior["log10_m_halo_msun"]
    return PosteriorFigure(
        **columns,
        accepted=accepted,
        bound=Bound(**{**headline, "warnings": tuple(meta["warnings"])}),
        m_range_kev=(low, high),
        halo_range=(halo_low, halo_high),
    )


def draw_posterior(data: PosteriorFigure) -> Figure:
    """The plane of both parameters beside the marginal with the bound."""
    figure, axes = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, 3.2))
    draw_posterior_plane(
        axes[0], data.m_th_kev, data.log10_m_halo_msun, data.accepted, data.m_range_kev, data.halo_range
    )
    draw_mass_marginal(axes[1], data.m_th_kev[data.accepted], data.bound, data.m_range_kev)
    return figure


@dataclass(frozen=True)
class LikelihoodFigure:
    """B(m) and the bound under other levels, rules and priors.

    Attributes
    ----------
    m_kev, ratio, band
        Grid [n] [keV], B [n], and its 16 and 84% quantiles over bootstrapped tables [2, n].
    crossings
        Value of B, mass where it falls to it and error [keV]; NaN where it does not or is not known.
    bounds
        The headline first.
    """

    m_kev: FloatArray
    ratio: FloatArray
    band: FloatArray
    crossings: FloatArray
    bounds: tuple[BoundRow, ...]

    def table(self) -> pd.DataFrame:
        """B on its grid, its crossings, and the bounds."""
        ratio = {"m_th_kev": self.m_kev, "b": self.ratio, "b_p16": self.band[0], "b_p84": self.band[1]}
        crossings = dict(zip(("b", "m_th_kev", "mc_error_kev"), self.crossings.T, strict=True))
        return panel_table(
            {
                "likelihood ratio": pd.DataFrame(ratio),
                "crossing": pd.DataFrame(crossings),
                "bound": pd.DataFrame([row.__dict__ for row in self.bounds]),
            }
        )


def read_likelihood(inputs: Inputs) -> LikelihoodFigure:
    """B(m) with its band, where it falls to 1/10 and 1/20, and the bounds that stand beside the headline."""
    with open_artifact(needed(inputs, "abc"), "abc") as artifact:
        meta = artifact.metadata
        m_kev, ratio, band = (artifact.array(f"likelihood/{name}") for name in ("m_kev", "ratio", "band"))
    found = meta["likelihood_ratio"]["falls_to"].values()
    crossings = [[item["ratio"], _number(item["m_kev"]), _number(item["mc_error_kev"])] for item in found]
    head = meta["bounds"][meta["headline"]]
    bounds = [_row("headline", head)]
    bounds += [
        _row(f"level {100 * (1 - item['level']):.4g}%", item)
        for name, item in meta["bounds"].items()
        if name != meta["headline"]
    ]
    bounds += [_row("rule: " + name.replace("_", " "), item) for name, item in meta["other_rules"].items()]
    bounds += [_row(_prior_name(name), meta["other_priors"][name]) for name in (*MASS_PRIORS, *HALO_MASS_PRIORS)]
    return LikelihoodFigure(m_kev, ratio, band, np.array(crossings, dtype=np.float64), tuple(bounds))


def draw_likelihood(data: LikelihoodFigure) -> Figure:
    """B(m) beside the bounds."""
    height = max(3.2, 0.9 + 0.19 * len(data.bounds))
    figure, axes = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, height), width_ratios=(1.25, 1.0))
    draw_likelihood_ratio(axes[0], data.m_kev, data.ratio, data.band, data.crossings)
    draw_bound_rows(axes[1], data.bounds)
    axes[0].set_xlabel(r"$m_{\rm TH}$ [keV]", fontsize=mpl.rcParams["axes.labelsize"])
    return figure


def _row(name: str, bound: dict[str, object]) -> BoundRow:
    """A bound of `abc.json`; NaN where a rule or prior was refused."""
    return BoundRow(name, *(_number(bound.get(key)) for key in ("value_kev", "mc_error_kev", "prior_only_kev")))


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def _prior_name(name: str) -> str:
    """Name of another prior, with its numbers if it is one of the halo mass."""
    if name in HALO_MASS_PRIORS:
        prior = HALO_MASS_PRIORS[name]
        kind = f"{prior.mean:g} to {prior.sigma:g}" if prior.flat else rf"{prior.mean:g} $\pm$ {prior.sigma:g}"
        return rf"prior: log $M_{{\rm h}}$ {kind}"
    return f"prior: uniform in {_UNIFORM_IN[name]}"
