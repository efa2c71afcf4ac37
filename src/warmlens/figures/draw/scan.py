"""Maps of the scan, and how its statistics are distributed over the positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter

from warmlens.figures.draw.sky import add_colour_bar, draw_diverging, draw_image
from warmlens.imaging.grid import PixelGrid
from warmlens.types import FloatArray

_BINS = 60
_LINEAR = 1.0  # of the asinh scale of Delta R: below, noise alone decides


@dataclass(frozen=True)
class ScanRow:
    """Maps of one band, or of all together; NaN is left blank.

    Attributes
    ----------
    name
        Of the band or the combination.
    delta_r
        Delta R of several images, each [ny, nx].
    r_sens
        Of the first of them [ny, nx].
    """

    name: str
    delta_r: Sequence[FloatArray]
    r_sens: FloatArray


@dataclass(frozen=True)
class AmplitudeRow:
    """Linear response of several images; NaN is left blank.

    Attributes
    ----------
    significance
        Best amplitude over its error of each image, [ny, nx].
    last
        What the data tell at each position [ny, nx]: an error or a mass.
    label
        What `last` is, with its unit.
    """

    significance: Sequence[FloatArray]
    last: FloatArray
    label: str


def draw_scan_row(axes: Sequence[Axes], row: ScanRow, grid: PixelGrid, limit: float, r_sens_limit: float) -> None:
    """Delta R of each image, then R_sens of the first; the name of the row stands beside its first panel.

    Parameters
    ----------
    axes
        One panel an image, and one more.
    row
        What they show.
    grid
        Positions of the scan.
    limit, r_sens_limit
        Values of full colour of Delta R, on both sides, and of R_sens.
    """
    for ax, delta in zip(axes[:-1], row.delta_r, strict=True):
        shown = draw_diverging(ax, delta, grid, limit)
        ax.label_outer()
    add_colour_bar(shown, axes[-2], r"$\Delta R$")
    shown = draw_image(axes[-1], row.r_sens, grid, "linear", (0.0, r_sens_limit), cmap="viridis")
    add_colour_bar(shown, axes[-1], r"$R_{\rm sens}$")
    axes[-1].label_outer()
    _name_row(axes[0], row.name)


def _name_row(first: Axes, name: str) -> None:
    """Name of the row beside its first panel, where it hides nothing."""
    first.set_ylabel(f"{name}\n{first.get_ylabel()}", fontsize=9)


def draw_amplitude_row(axes: Sequence[Axes], row: AmplitudeRow, grid: PixelGrid, limit: float) -> None:
    """Best amplitude of each image in units of its error, then the error, or the mass that would be seen.

    Parameters
    ----------
    axes, row, grid
        As in `draw_scan_row`.
    limit
        Significance of full colour.
    """
    for ax, significance in zip(axes[:-1], row.significance, strict=True):
        shown = draw_diverging(ax, significance, grid, limit)
        ax.label_outer()
    add_colour_bar(shown, axes[-2], r"$\hat\epsilon\,/\,\sigma_\epsilon$")
    _name_row(axes[0], "all bands")
    if np.isfinite(row.last).any():
        finite = row.last[np.isfinite(row.last)]
        low, high = float(finite.min()), float(np.percentile(finite, 95.0))
        limits = (low, high) if low < high else (0.9 * low, 1.1 * low)
        shown = draw_image(axes[-1], row.last, grid, "log", limits, cmap="viridis_r")
        add_colour_bar(shown, axes[-1], row.label)
    else:
        draw_diverging(axes[-1], row.last, grid, 1.0)
        axes[-1].text(0.5, 0.5, "nothing within\nthe list", transform=axes[-1].transAxes, ha="center", va="center")
    axes[-1].label_outer()


def draw_scan_plane(plane: Axes, top: Axes, right: Axes, maps: dict[str, tuple[FloatArray, FloatArray]]) -> None:
    """Positions in the plane of Delta R and R_sens, and both marginal distributions.

    The legend is left to the figure: there is no place in the plane that no position can take.

    Parameters
    ----------
    plane, top, right
        The panel, and those of the histograms of Delta R above and of R_sens beside it.
    maps
        Delta R and R_sens of the positions [n] by name; one colour each.

    Reference: Birrer+2017, Figs 6 and 7.
    """
    delta_all = np.concatenate([delta for delta, _ in maps.values()])
    sens_all = np.concatenate([sens for _, sens in maps.values()])
    lit = sens_all[sens_all > 0.0]
    low, high = max(float(lit.min()), 1e-4 * float(lit.max())), 1.3 * float(lit.max())
    reach = 1.1 * float(np.abs(delta_all).max())
    plane.set_xscale("asinh", linear_width=_LINEAR)
    plane.set_yscale("log")
    scale = plane.xaxis.get_transform()
    span = float(scale.transform(np.array([reach]))[0])
    edges = scale.inverted().transform(np.linspace(-span, span, _BINS + 1)).tolist()
    sens_edges = np.geomspace(low, high, _BINS + 1).tolist()
    colours = cycle(mpl.rcParams["axes.prop_cycle"].by_key()["color"])
    for (name, (delta, sens)), colour in zip(maps.items(), colours, strict=False):
        size = float(np.clip(4000.0 / delta.size, 0.5, 6.0))
        plane.scatter(delta, sens, s=size, c=colour, alpha=0.5, lw=0, label=name, rasterized=True)
        top.hist(delta, edges, histtype="step", color=colour, lw=1.2)
        right.hist(sens, sens_edges, histtype="step", color=colour, lw=1.2, orientation="horizontal")
    line = np.geomspace(low, high, 100)
    plane.plot(line, line, color="black", lw=0.8, ls=":", label=r"$\Delta R = R_{\rm sens}$")
    plane.plot(-line, line, color="black", lw=0.8, ls="--", label=r"$\Delta R = -R_{\rm sens}$")
    plane.set_xlim(-reach, reach)
    plane.set_ylim(low, high)
    plane.set_xlabel(r"$\Delta R = R_{\rm pert} - R_{\rm smooth}$")
    plane.set_ylabel(r"$R_{\rm sens}$")
    ticks = [value for value in (-100.0, -10.0, -1.0, 0.0, 1.0, 10.0, 100.0) if abs(value) <= reach]
    plane.set_xticks(ticks, [f"{value:g}".replace("-", "\u2212") for value in ticks])
    for ax in (top, right):
        ax.tick_params(labelbottom=ax is right, labelleft=ax is top)
    top.set_yscale("log")
    right.set_xscale("log")
    top.set_ylabel("positions")
    right.set_xlabel("positions")
    top.yaxis.set_minor_formatter(NullFormatter())
    right.xaxis.set_minor_formatter(NullFormatter())
