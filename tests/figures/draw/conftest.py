from __future__ import annotations

import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest

from warmlens.figures.draw.style import house_style


@pytest.fixture
def panel():
    """One panel in the house style, on a canvas without a screen."""
    mpl.use("Agg")
    with house_style():
        figure, ax = plt.subplots()
        yield ax
        figure.canvas.draw()  # whatever was put on the panel can be rendered
        plt.close(figure)
