"""What the accepted samples say about the dark matter mass."""

from __future__ import annotations

from contextlib import redirect_stdout
from io import StringIO
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.contour import QuadContourSet
from matplotlib.patches import Rectangle
from matplotlib.ticker import AutoMinorLocator

from warmlens.inference.bound import Bound
from warmlens.inference.likelihood import BoundaryKernels, silverman
from warmlens.types import BoolArray, FloatArray

if TYPE_CHECKING:
    from getdist import MCSamples

MIN_FOR_DENSITY = 30
_GRID = 200
REGIONS = (0.683, 0.954)  # probability inside the highest-density contours
COLOUR, LIGHT, EXCLUDED = "#1f5f8b", "#a9cbe0", "#c1403d"
MASS_LABEL = r"$m_{\rm TH}$ [keV]"


def draw_posterior_plane(
    ax: Axes,
    m_kev: FloatArray,
    log10_mass_msun: FloatArray,
    accepted: BoolArray,
    m_range_kev: tuple[float, float],
    log10_mass_range: tuple[float, float],
    weights: FloatArray | None = None,
) -> QuadContourSet | None:
    """Accepted samples over all samples, with the 68.3% and 95.4% highest-density regions.

    Parameters
    ----------
    ax
        Where to draw.
    m_kev, log10_mass_msun
        Thermal relic mass [keV] and log10 of the halo mass [Msun] of all samples, each [n].
    accepted
        Which are accepted [n].
    m_range_kev, log10_mass_range
        Edges of the prior; the density is corrected for them.
    weights
        Prior weights of all samples [n]; all equal unless given.

    Returns
    -------
    contours
        The filled regions; None below `MIN_FOR_DENSITY` accepted samples, where the panel says so instead.

    Reference: Birrer+2017, figure of the constraints (left).
    """
    k = int(accepted.sum())
    size_all = float(np.clip(8000.0 / m_kev.size, 0.5, 4.0))
    ax.scatter(
        m_kev,
        log10_mass_msun,
        s=size_all,
        color="0.75",
        linewidths=0,
        label=f"all {m_kev.size}",
        rasterized=True,
    )
    contours = None
    if k >= MIN_FOR_DENSITY:
        density = _density_samples(
            {"m": m_kev[accepted], "M": log10_mass_msun[accepted]},
            {"m": m_range_kev, "M": log10_mass_range},
            None if weights is None else weights[accepted],
        ).get2DDensity("m", "M")
        inner, outer = density.getContourLevels(REGIONS)
        contours = ax.contourf(
            density.x,
            density.y,
            density.P,
            levels=[outer, inner, max(density.P.max(), inner) * 1.001],
            colors=[LIGHT, COLOUR],
            alpha=0.65,
        )
        ax.contour(density.x, density.y, density.P, levels=[outer, inner], colors=COLOUR, linewidths=0.9)
        for probability, colour in zip(REGIONS, (COLOUR, LIGHT), strict=True):
            ax.add_patch(
                Rectangle((0, 0), 0, 0, fc=colour, ec=COLOUR, alpha=0.65, label=f"{100 * probability:g}%")
            )
    else:
        _note_too_few(ax, k)
    size = float(np.clip(800.0 / max(k, 1), 1.5, 22.0))
    ax.scatter(
        m_kev[accepted],
        log10_mass_msun[accepted],
        s=size,
        color="black",
        edgecolors="white",
        linewidths=0.3 if size > 3.0 else 0.0,
        label=f"accepted {k}",
        zorder=3,
    )
    ax.set_xlim(*m_range_kev)
    ax.set_ylim(*log10_mass_range)
    ax.set_xlabel(MASS_LABEL)
    ax.set_ylabel(r"$\log_{10}\,(M_{\rm h}/{\rm M}_\odot)$")
    _legend_above(ax, 4)
    return contours


def draw_mass_marginal(
    ax: Axes,
    m_kev: FloatArray,
    bound: Bound,
    m_range_kev: tuple[float, float],
    weights: FloatArray | None = None,
) -> None:
    """Marginal distribution of the thermal relic mass, with what the bound excludes shaded.

    Parameters
    ----------
    ax
        Where to draw.
    m_kev
        Thermal relic mass of the accepted samples [keV], [k].
    bound
        The bound to show, from `lower_bounds`; with it the bound that the prior alone would give.
    m_range_kev
        Edges of the prior; the density is corrected for them.
    weights
        Prior weights of the accepted samples [k]; all equal unless given.

    Reference: Birrer+2017, figure of the constraints (right).
    """
    low, high = m_range_kev
    n_bins = int(np.clip(2.0 * np.cbrt(m_kev.size), 4, 24))
    ax.hist(m_kev, bins=n_bins, range=m_range_kev, weights=weights, density=True, color="0.88", edgecolor="0.7")
    if m_kev.size >= MIN_FOR_DENSITY:
        grid = np.linspace(low, high, _GRID)
        kernels = BoundaryKernels(grid, m_kev, silverman(m_kev, m_range_kev), m_range_kev)
        density = kernels.density(np.ones((1, m_kev.size)) if weights is None else weights[None])[0]
        ax.plot(grid, density / np.trapezoid(density, grid), color=COLOUR, lw=1.8)
    else:
        _note_too_few(ax, m_kev.size)
    ax.axvspan(low, bound.value_kev, color=EXCLUDED, alpha=0.18, lw=0)
    error = rf"{bound.value_kev:.2f} \pm {bound.mc_error_kev:.2f}"
    ax.axvline(
        bound.value_kev,
        color=EXCLUDED,
        lw=1.2,
        label=rf"$m_{{\rm TH}} > {error}$ keV ({100.0 * (1.0 - bound.level):g}%)",
    )
    ax.axvline(
        bound.prior_only_kev,
        color="black",
        ls="--",
        lw=1.0,
        label=f"prior alone: {bound.prior_only_kev:.2f} keV",
    )
    ax.set_xlim(low, high)
    ax.set_ylim(0.0, 1.08 * ax.get_ylim()[1])
    ax.xaxis.set_minor_locator(AutoMinorLocator())
    ax.set_xlabel(MASS_LABEL)
    ax.set_ylabel(r"posterior density [keV$^{-1}$]")
    _legend_above(ax, 2)


def _note_too_few(ax: Axes, k: int) -> None:
    """Say in the panel why it shows no density."""
    note = f"{k} accepted: too few for a density"
    box = {"boxstyle": "round,pad=0.3", "facecolor": "white", "edgecolor": "0.7", "linewidth": 0.6}
    ax.text(0.5, 0.06, note, transform=ax.transAxes, ha="center", fontsize=9, bbox=box, zorder=6)


def _legend_above(ax: Axes, n_columns: int) -> None:
    """Legend between the panel and its title, where it hides nothing."""
    ax.legend(
        loc="lower left",
        bbox_to_anchor=(-0.02, 0.99),
        ncols=n_columns,
        columnspacing=1.0,
        handlelength=1.1,
        handletextpad=0.4,
        markerscale=1.5,
        borderaxespad=0.1,
    )


def _density_samples(
    columns: dict[str, FloatArray], ranges: dict[str, tuple[float, float]], weights: FloatArray | None
) -> MCSamples:
    """Independent samples whose densities getdist corrects at the hard edges of the prior, to first order."""
    from getdist import MCSamples

    with redirect_stdout(StringIO()):  # getdist announces that it removed no burn-in
        return MCSamples(
            samples=np.column_stack(list(columns.values())),
            weights=weights,
            names=list(columns),
            ranges=ranges,
            sampler="uncorrelated",
            settings={"boundary_correction_order": 1},
        )
