"""The one style of all figures."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import as_file, files

import matplotlib.pyplot as plt

SINGLE_COLUMN_INCH = 3.5
FULL_WIDTH_INCH = 7.2


@contextmanager
def house_style() -> Iterator[None]:
    """Make figures in the style of `warmlens.mplstyle`; what was set before comes back after."""
    with as_file(files("warmlens.figures.draw") / "warmlens.mplstyle") as path, plt.style.context(path):
        yield
