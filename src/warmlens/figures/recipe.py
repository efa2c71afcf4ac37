"""How a figure is made: read its data, draw them, write the picture with the data as a table beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from warmlens.artifacts.atomic import atomic_path
from warmlens.figures.draw.style import house_style
from warmlens.imaging.grid import PixelGrid
from warmlens.types import FloatArray

_DIGITS = "%.6g"

DataT = TypeVar("DataT")
SourceT = TypeVar("SourceT")


@dataclass(frozen=True)
class Recipe(Generic[SourceT, DataT]):
    """The three steps of a figure: read its data from artifacts or a configuration, draw them, tabulate them.

    The table has the units in the names of its columns; what does not apply is empty.
    """

    read: Callable[[SourceT], DataT]
    draw: Callable[[DataT], Figure]
    tabulate: Callable[[DataT], pd.DataFrame]

    def write(self, source: SourceT, output: Path, title: str = "") -> None:
        """Write the picture as .png, .pdf or .svg under a title, and its data as CSV beside it."""
        kind = output.suffix.removeprefix(".")
        if kind not in ("png", "pdf", "svg"):
            raise ValueError(f"output {output} must end in .png, .pdf or .svg")
        with house_style():
            data = self.read(source)
            figure = self.draw(data)
            if title:
                figure.suptitle(title, fontsize=8.5, x=0.01, ha="left")
            with atomic_path(output.with_suffix(".csv")) as temporary:
                self.tabulate(data).to_csv(temporary, index=False, float_format=_DIGITS)
            with atomic_path(output) as temporary:
                figure.savefig(temporary, format=kind)
            plt.close(figure)


def map_table(grid: PixelGrid, columns: Mapping[str, FloatArray]) -> pd.DataFrame:
    """Return maps [ny, nx] on one grid as columns, with the positions x, y [arcsec] of the pixels first.

    Pixels at which every map is NaN are left out.
    """
    x, y = grid.coordinates()
    table = pd.DataFrame({"x_arcsec": x.ravel(), "y_arcsec": y.ravel()})
    values = pd.DataFrame({name: np.asarray(data, dtype=np.float64).ravel() for name, data in columns.items()})
    return pd.concat([table, values], axis=1)[values.notna().any(axis=1)].reset_index(drop=True)


def panel_table(panels: Mapping[str, pd.DataFrame], column: str = "panel") -> pd.DataFrame:
    """Return the tables of several panels as one, the name of the panel in the first column."""
    frames = [frame.assign(**{column: name})[[column, *frame.columns]] for name, frame in panels.items()]
    return pd.concat(frames, ignore_index=True)
