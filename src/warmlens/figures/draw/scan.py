"""Maps of the scan of one band, or of all together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from warmlens.figures.draw.sky import add_colour_bar, draw_diverging, draw_image
from warmlens.imaging.grid import PixelGrid
from warmlens.types import FloatArray


@dataclass(frozen=True)
class ScanRow:
    """Maps of one band, or of all together: Delta R of several images, R_sens of the first, each [ny, nx]."""

    name: str
    delta_r: Sequence[FloatArray]
    r_sens: FloatArray


def draw_scan_row(
    axes: Sequence[Axes], row: ScanRow, grid: PixelGrid, limit: float = 25.0, r_sens_limit: float | None = None
) -> None:
    """Draw Delta R of each image, then R_sens of the first; the label of the first panel names the row.

    Parameters
    ----------
    axes, row, grid
        One panel per image and one more, the maps (NaN is left blank), and the positions of the scan.
    limit
        Delta R of full colour, on both sides.
    r_sens_limit
        R_sens of full colour; the 99.5th percentile unless given.
    """
    draw_signed_maps(axes[:-1], row.delta_r, grid, limit, r"$\Delta R$")
    name_row(axes[0], row.name)
    if r_sens_limit is None:
        brightest = float(np.nanpercentile(row.r_sens, 99.5))
        r_sens_limit = brightest if brightest > 0.0 else 1.0
    shown = draw_image(axes[-1], row.r_sens, grid, "linear", (0.0, r_sens_limit), cmap="viridis")
    add_colour_bar(shown, axes[-1], r"$R_{\rm sens}$")
    axes[-1].label_outer()


def draw_signed_maps(
    axes: Sequence[Axes], maps: Sequence[FloatArray], grid: PixelGrid, limit: float, label: str
) -> None:
    """Draw maps on one scale from -limit to limit, with the colour bar of that label on the last panel."""
    for ax, field in zip(axes, maps, strict=True):
        shown = draw_diverging(ax, field, grid, limit)
        ax.label_outer()
    add_colour_bar(shown, axes[-1], label)


def name_row(first: Axes, name: str) -> None:
    """Name a row in the label of its first panel, where it hides nothing."""
    first.set_ylabel(f"{name}\n{first.get_ylabel()}", fontsize=9)
