"""How a figure is made: read its data from artifacts, draw them, write the picture and the data beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from warmlens.artifacts.file import ArtifactError, atomic_path
from warmlens.imaging.grid import PixelGrid
from warmlens.types import FloatArray

_DIGITS = "%.6g"


class Tabular(Protocol):
    """Data of a figure that can be written as a table."""

    def table(self) -> pd.DataFrame:
        """What the figure shows, units in the names of the columns; what does not apply is empty."""
        ...


DataT = TypeVar("DataT", bound=Tabular)
SourceT = TypeVar("SourceT")


@dataclass(frozen=True)
class Recipe(Generic[SourceT, DataT]):
    """A figure: what it reads of its source (artifacts, or a configuration), and how that is drawn."""

    read: Callable[[SourceT], DataT]
    draw: Callable[[DataT], Figure]

    def write(self, source: SourceT, output: Path) -> None:
        """Write the picture, and its data as CSV beside it.

        Parameters
        ----------
        source
            What `read` takes.
        output
            Path of the picture; the ending says its format: .png, .pdf or .svg.
        """
        import matplotlib.pyplot as plt

        from warmlens.figures.draw.style import house_style

        kind = output.suffix.removeprefix(".")
        if kind not in ("png", "pdf", "svg"):
            raise ValueError(f"output {output} must end in .png, .pdf or .svg")
        with house_style():
            data = self.read(source)
            figure = self.draw(data)
            with atomic_path(output.with_suffix(".csv")) as temporary:
                data.table().to_csv(temporary, index=False, float_format=_DIGITS)
            with atomic_path(output) as temporary:
                figure.savefig(temporary, format=kind)
            plt.close(figure)


def map_table(grid: PixelGrid, columns: Mapping[str, FloatArray]) -> pd.DataFrame:
    """Maps [ny, nx] on one grid as columns beside the positions x, y [arcsec] of the pixels.

    Pixels at which every map is NaN are left out.
    """
    x, y = grid.coordinates()
    table = pd.DataFrame({"x_arcsec": x.ravel(), "y_arcsec": y.ravel()})
    values = pd.DataFrame({name: np.asarray(data, dtype=np.float64).ravel() for name, data in columns.items()})
    return pd.concat([table, values], axis=1)[values.notna().any(axis=1)].reset_index(drop=True)


def panel_table(panels: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Tables of the panels of one figure one below the other, the name of the panel first."""
    frames = []
    for name, frame in panels.items():
        frames.append(frame.assign(panel=name)[["panel", *frame.columns]])
    return pd.concat(frames, ignore_index=True)


def needed(inputs: Mapping[str, Path], key: str) -> Path:
    """Path of an input, or an error that says how it is given."""
    if key not in inputs:
        raise ArtifactError(
            f"the figure needs the artifact {key!r}; give --artifact {key}=PATH, or --results with the folder of "
            f"the campaign; given: {', '.join(inputs) or 'none'}"
        )
    return inputs[key]


def all_of(inputs: Mapping[str, Path], stage: str) -> list[Path]:
    """Paths of all chunks of a stage, in the order of their numbers."""
    keys = [key for key in inputs if key.startswith(f"{stage}/")]
    if not keys:
        return [needed(inputs, f"{stage}/0")]
    return [inputs[key] for key in sorted(keys, key=lambda key: int(key.removeprefix(f"{stage}/")))]
