"""Cumulative mass and velocity functions of subhaloes, one colour a dark matter model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from warmlens.types import FloatArray

REFERENCE_DASHES = {"Lovell+14": (0, (5, 2)), "Lovell 20": (0, (1, 1.5))}


def draw_cumulative_functions(
    ax: Axes,
    grid: FloatArray,
    realizations: Mapping[str, FloatArray],
    references: Mapping[str, Mapping[str, FloatArray]],
    label: str,
) -> None:
    """Mean of the realizations of each model as a line, each realization faint, references dashed.

    Parameters
    ----------
    ax
        Where to draw; both axes become logarithmic.
    grid
        Values above which subhaloes are counted [n].
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
            ax.plot(grid, _positive(row), color=colours[model], lw=0.5, alpha=0.35)
        ax.plot(grid, _positive(counts.mean(axis=0)), color=colours[model], label=model)
    for name, curves in references.items():
        for model, curve in curves.items():
            ax.plot(grid, _positive(curve), color=colours[model], lw=0.9, ls=REFERENCE_DASHES[name])
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel(label)
    handles, _ = ax.get_legend_handles_labels()
    handles += [Line2D([], [], color="0.4", lw=0.9, ls=REFERENCE_DASHES[name], label=name) for name in references]
    ax.legend(handles=handles)


def model_colours(models: Sequence[str]) -> dict[str, tuple[float, float, float, float]]:
    """Colours from warm to cold, in the order of the models."""
    shades = mpl.colormaps["viridis_r"](np.linspace(0.12, 1.0, len(models)))
    return {model: tuple(shade) for model, shade in zip(models, shades, strict=True)}


def _positive(counts: FloatArray) -> FloatArray:
    """Counts with 0 left out, which a logarithmic axis cannot show."""
    return np.where(counts > 0, counts, np.nan)
