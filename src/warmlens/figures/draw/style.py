"""The one style of all figures: their widths, their colours, and the settings of matplotlib."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import as_file, files

import matplotlib as mpl
import matplotlib.pyplot as plt

SINGLE_COLUMN_INCH = 3.5
FULL_WIDTH_INCH = 7.2
BLUE, LIGHT_BLUE, RED, ORANGE = "#1f5f8b", "#a9cbe0", "#c1403d", "#d99a2b"


@contextmanager
def house_style() -> Iterator[None]:
    """Make figures in the style of `warmlens.mplstyle`, and restore the former settings afterwards.

    The style begins with matplotlib's defaults: a matplotlibrc of the user changes no picture.
    """
    with as_file(files("warmlens.figures.draw") / "warmlens.mplstyle") as path, mpl.rc_context():
        mpl.rcdefaults()
        plt.style.use(path)
        yield
