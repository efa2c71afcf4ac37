"""Cumulative mass and velocity functions of subhalos, one colour per dark matter model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from warmlens.figures.draw.axes import mask_not_positive
from warmlens.types import FloatArray

REFERENCE_DASHES = {"Lovell+14": (0, (5, 2)), "Lovell 20": (0, (1, 1.5))}


def draw_cumulative_functions(
    ax: Axes,
    grid: FloatArray,
    realizations: Mapping[str, FloatArray],
    references: Mapping[str, Mapping[str, FloatArray]],
    label: str,
) -> None:
    """Draw the mean of the realizations of each model, each realization faint, references dashed.

    Parameters
    ----------
    ax, grid
        Where to draw, on logarithmic axes, and the values above which subhalos are counted [n].
    realizations
        N(> grid) of each realization by model, [n_realization, n].
    references
        Published expectations of N(> grid) by name of the fit and model, [n].
    label
        Of the abscissa, with its unit.
    """
    colours = model_colours(list(realizations))
    for model, counts in realizations.items():
        for row in counts:
            ax.plot(grid, mask_not_positive(row), color=colours[model], lw=0.5, alpha=0.35)
        ax.plot(grid, mask_not_positive(counts.mean(axis=0)), color=colours[model], label=model)
    for name, curves in references.items():
        for model, curve in curves.items():
            ax.plot(grid, mask_not_positive(curve), color=colours[model], lw=0.9, ls=REFERENCE_DASHES[name])
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel(label)
    handles, _ = ax.get_legend_handles_labels()
    handles += [Line2D([], [], color="0.4", lw=0.9, ls=REFERENCE_DASHES[name], label=name) for name in references]
    ax.legend(handles=handles)


def model_colours(models: Sequence[str]) -> dict[str, tuple[float, float, float, float]]:
    """Return the colour of each model, from warm to cold in their order."""
    shades = mpl.colormaps["viridis_r"](np.linspace(0.12, 1.0, len(models)))
    return {model: tuple(shade) for model, shade in zip(models, shades, strict=True)}
