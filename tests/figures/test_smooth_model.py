from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import AsinhNorm
from matplotlib.patches import Circle

from warmlens.figures.draw.sky import brightness_limits
from warmlens.figures.draw.style import house_style
from warmlens.figures.smooth_model import BandMaps, SmoothModelFigure, draw, draw_curves
from warmlens.imaging.grid import PixelGrid
from warmlens.lensing.critical_curves import CriticalCurve

GRID = PixelGrid.centred((8, 8), 0.5)
SOURCE_GRID = PixelGrid.centred((10, 10), 0.1, x=0.2)
RING = np.column_stack([np.cos(np.linspace(0, 2 * np.pi, 30)), np.sin(np.linspace(0, 2 * np.pi, 30))])
CURVE = CriticalCurve(RING, 0.1 * RING)
QUASARS, QUASAR_SOURCE = np.array([[1.0, 0.5], [-1.0, 0.2]]), np.array([[0.1, 0.0], [0.12, 0.02]])


def maps() -> BandMaps:
    rng = np.random.default_rng(1)
    blank = np.zeros(GRID.shape, dtype=bool)
    blank[0, 0] = True
    image = 10.0 * rng.random(GRID.shape)
    return BandMaps(
        name="F814W",
        data=image,
        model=np.where(blank, np.nan, image),
        residual=np.where(blank, np.nan, rng.standard_normal(GRID.shape)),
        source=rng.random(SOURCE_GRID.shape),
        chi2_red=1.0349,
    )


@pytest.fixture
def panels():
    shown = maps()
    with house_style():
        figure = draw(SmoothModelFigure((shown,), GRID, SOURCE_GRID, [CURVE], QUASARS, QUASAR_SOURCE, 0.25))
        figure.canvas.draw()
        yield shown, figure.axes
        plt.close(figure)


def test_panels_show_their_arrays_and_leave_masked_pixels_blank(panels):
    shown, axes = panels
    for ax, name in zip(axes, ("data", "model", "residual", "source"), strict=True):
        expected = getattr(shown, name)
        array = ax.images[0].get_array()
        np.testing.assert_array_equal(np.ma.getmaskarray(array), np.isnan(expected))
        np.testing.assert_array_equal(array.compressed(), expected[np.isfinite(expected)])
    fitted = brightness_limits(np.where(np.isfinite(shown.model), shown.data, np.nan))
    assert axes[0].images[0].get_clim() == axes[1].images[0].get_clim() == fitted
    assert isinstance(axes[3].images[0].norm, AsinhNorm)
    low, high = axes[2].images[0].get_clim()
    assert low == -high


def test_chi2_and_units_are_written(panels):
    _, axes = panels
    assert "1.03" in axes[2].texts[0].get_text()
    labels = [ax.child_axes[0].get_xlabel() for ax in axes]
    assert "px" in labels[0]
    assert "px" in labels[1]
    assert "sigma" in labels[2]
    assert "arcsec$^{-2}$" in labels[3]


def test_curves_quasars_and_source_position_stand_where_they_are(panels):
    _, axes = panels
    np.testing.assert_array_equal(axes[1].lines[0].get_xydata(), RING)
    np.testing.assert_array_equal(axes[3].lines[0].get_xydata(), 0.1 * RING)
    np.testing.assert_allclose(axes[3].lines[1].get_xydata(), [[0.11, 0.01]])
    for ax in (axes[0], axes[2]):
        circles = [patch for patch in ax.patches if isinstance(patch, Circle)]
        np.testing.assert_array_equal([circle.center for circle in circles], QUASARS)
        assert {circle.radius for circle in circles} == {0.25}


def test_curves_leave_the_limits_of_the_panel(panel):
    panel.set_xlim(-0.5, 0.5)
    panel.set_ylim(-0.2, 0.2)
    draw_curves(panel, [RING])
    assert (panel.get_xlim(), panel.get_ylim()) == ((-0.5, 0.5), (-0.2, 0.2))


def test_lens_without_quasars_and_critical_curves():
    none = np.empty((0, 2))
    with house_style():
        figure = draw(SmoothModelFigure((maps(),), GRID, SOURCE_GRID, [], none, none, 0.25))
        figure.canvas.draw()
    assert not figure.axes[3].lines
    plt.close(figure)


def test_key_names_every_sign(panels):
    _, axes = panels
    (legend,) = axes[0].figure.legends
    assert len({text.get_text() for text in legend.get_texts()}) == 3
