"""Figure posterior and Fig. 5: the accepted samples, and the marginal distribution of m_TH with its bound."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import AutoMinorLocator

from warmlens.figures.draw.axes import MASS_LABEL, legend_above
from warmlens.figures.draw.style import BLUE, FULL_WIDTH_INCH, LIGHT_BLUE, RED
from warmlens.figures.inputs import Inputs, open_input
from warmlens.figures.recipe import panel_table
from warmlens.inference.likelihood import BoundaryKernels, silverman

if TYPE_CHECKING:
    from getdist import MCSamples

MIN_FOR_DENSITY = 30
REGIONS = (0.683, 0.954)  # probability inside the highest-density contours
_GRID = 200
_LEGEND: dict[str, Any] = {"columnspacing": 1.0, "handlelength": 1.1, "handletextpad": 0.4, "markerscale": 1.5}


@dataclass(frozen=True)
class PosteriorFigure:
    """Samples and bound.

    Attributes
    ----------
    samples
        sample_id, m_th_kev, log10_m_halo_msun, accepted (bool) of all samples that have not failed.
    bound
        The headline: level, value_kev, mc_error_kev, prior_only_kev.
    m_range_kev, halo_range
        Edges of the prior in m_TH [keV] and log10 of the halo mass [Msun].
    """

    samples: pd.DataFrame
    bound: Mapping[str, float]
    m_range_kev: tuple[float, float]
    halo_range: tuple[float, float]

    @property
    def accepted(self) -> pd.DataFrame:
        """Samples that are accepted."""
        return self.samples[self.samples["accepted"]]


def read(inputs: Inputs) -> PosteriorFigure:
    """Return all samples, which are accepted, and the headline bound."""
    with open_input(inputs, "abc") as artifact:
        prior, meta = artifact.settings["dark_matter"], artifact.metadata
        good = artifact.array("table/status") == 0
        names = ("sample_id", "m_th_kev", "log10_m_halo_msun", "accepted")
        samples = pd.DataFrame({name: artifact.array(f"table/{name}")[good] for name in names})
    return PosteriorFigure(
        samples=samples.astype({"accepted": bool}),
        bound=meta["bounds"][meta["headline"]],
        m_range_kev=tuple(prior["m_th_kev"]),
        halo_range=tuple(prior["log10_m_halo_msun"]),
    )


def draw(data: PosteriorFigure) -> Figure:
    """Draw the plane of both parameters, and the marginal with the bound."""
    figure, axes = plt.subplots(1, 2, figsize=(FULL_WIDTH_INCH, 3.2))
    draw_posterior_plane(axes[0], data)
    draw_mass_marginal(axes[1], data)
    return figure


def draw_posterior_plane(ax: Axes, data: PosteriorFigure) -> QuadContourSet | None:
    """Draw accepted samples over all samples, with the 68.3% and 95.4% highest-density regions.

    Returns
    -------
    contours
        The filled regions; None below `MIN_FOR_DENSITY` accepted samples, where the panel says so instead.

    Reference: Birrer+2017, figure of the constraints (left).
    """
    n, k = len(data.samples), len(data.accepted)
    ax.scatter(
        data.samples["m_th_kev"],
        data.samples["log10_m_halo_msun"],
        s=float(np.clip(8000.0 / n, 0.5, 4.0)),
        color="0.75",
        linewidths=0,
        label=f"all {n}",
        rasterized=True,
    )
    contours = None
    if k >= MIN_FOR_DENSITY:
        density = _getdist_samples(data).get2DDensity("m", "M")
        inner, outer = density.getContourLevels(REGIONS)
        grid = density.x, density.y, density.P
        levels = [outer, inner, max(density.P.max(), inner) * 1.001]
        contours = ax.contourf(*grid, levels=levels, colors=[LIGHT_BLUE, BLUE], alpha=0.65)
        ax.contour(*grid, levels=[outer, inner], colors=BLUE, linewidths=0.9)
        for probability, colour in zip(REGIONS, (BLUE, LIGHT_BLUE), strict=True):
            label = f"{100 * probability:g}%"
            ax.add_patch(Rectangle((0, 0), 0, 0, fc=colour, ec=BLUE, alpha=0.65, label=label))
    else:
        _note_too_few(ax, k)
    size = float(np.clip(800.0 / max(k, 1), 1.5, 22.0))
    ax.scatter(
        data.accepted["m_th_kev"],
        data.accepted["log10_m_halo_msun"],
        s=size,
        color="black",
        edgecolors="white",
        linewidths=0.3 if size > 3.0 else 0.0,
        label=f"accepted {k}",
        zorder=3,
    )
    ax.set_xlim(*data.m_range_kev)
    ax.set_ylim(*data.halo_range)
    ax.set_xlabel(MASS_LABEL)
    ax.set_ylabel(r"$\log_{10}\,(M_{\rm h}/{\rm M}_\odot)$")
    legend_above(ax, 4, **_LEGEND)
    return contours


def draw_mass_marginal(ax: Axes, data: PosteriorFigure) -> None:
    """Draw the marginal distribution of m_TH, corrected for the edges of the prior, and shade what is excluded.

    Reference: Birrer+2017, figure of the constraints (right).
    """
    m_kev, bound = data.accepted["m_th_kev"].to_numpy(), data.bound
    low, high = data.m_range_kev
    n_bins = int(np.clip(2.0 * np.cbrt(m_kev.size), 4, 24))
    ax.hist(m_kev, bins=n_bins, range=data.m_range_kev, density=True, color="0.88", edgecolor="0.7")
    if m_kev.size >= MIN_FOR_DENSITY:
        grid = np.linspace(low, high, _GRID)
        kernels = BoundaryKernels(grid, m_kev, silverman(m_kev, data.m_range_kev), data.m_range_kev)
        density = kernels.density(np.ones((1, m_kev.size)))[0]
        ax.plot(grid, density / np.trapezoid(density, grid), color=BLUE, lw=1.8)
    else:
        _note_too_few(ax, m_kev.size)
    value = bound["value_kev"]
    ax.axvspan(low, value, color=RED, alpha=0.18, lw=0)
    error = rf"{value:.2f} \pm {bound['mc_error_kev']:.2f}"
    label = rf"$m_{{\rm TH}} > {error}$ keV ({100.0 * (1.0 - bound['level']):g}%)"
    ax.axvline(value, color=RED, lw=1.2, label=label)
    prior_only = bound["prior_only_kev"]
    ax.axvline(prior_only, color="black", ls="--", lw=1.0, label=f"prior alone: {prior_only:.2f} keV")
    ax.set_xlim(low, high)
    ax.set_ylim(0.0, 1.08 * ax.get_ylim()[1])
    ax.xaxis.set_minor_locator(AutoMinorLocator())
    ax.set_xlabel(MASS_LABEL)
    ax.set_ylabel(r"posterior density [keV$^{-1}$]")
    legend_above(ax, 2, **_LEGEND)


def _note_too_few(ax: Axes, k: int) -> None:
    """Say in the panel why it shows no density."""
    note = f"{k} accepted: too few for a density"
    box = {"boxstyle": "round,pad=0.3", "facecolor": "white", "edgecolor": "0.7", "linewidth": 0.6}
    ax.text(0.5, 0.06, note, transform=ax.transAxes, ha="center", fontsize=9, bbox=box, zorder=6)


def _getdist_samples(data: PosteriorFigure) -> MCSamples:
    """Return the accepted samples, their density to be corrected at the edges of the prior to first order."""
    from getdist import MCSamples  # takes a second to import, and few accepted samples do without

    with redirect_stdout(StringIO()):  # getdist announces that it removed no burn-in
        return MCSamples(
            samples=data.accepted[["m_th_kev", "log10_m_halo_msun"]].to_numpy(),
            names=["m", "M"],
            ranges={"m": data.m_range_kev, "M": data.halo_range},
            sampler="uncorrelated",
            settings={"boundary_correction_order": 1},
        )


def tabulate(data: PosteriorFigure) -> pd.DataFrame:
    """Return the samples, and the bound in a row of its own."""
    bound = pd.DataFrame([data.bound]).rename(columns={"value_kev": "bound_kev"})
    columns = ["level", "bound_kev", "mc_error_kev", "prior_only_kev"]
    return panel_table({"samples": data.samples.astype({"accepted": int}), "bound": bound[columns]})
