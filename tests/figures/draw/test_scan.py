from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from warmlens.figures.draw.scan import AmplitudeRow, ScanRow, draw_amplitude_row, draw_scan_plane, draw_scan_row
from warmlens.figures.draw.style import house_style
from warmlens.imaging.grid import PixelGrid

GRID = PixelGrid.centred((4, 6), 0.1)
MAP = np.linspace(-30.0, 20.0, 24).reshape(4, 6)
SENS = np.linspace(0.0, 60.0, 24).reshape(4, 6)


@pytest.fixture
def axes():
    with house_style():
        figure, panels = plt.subplots(1, 4, figsize=(9.6, 2.4))
        yield panels
        plt.close(figure)


def shown(ax):
    return ax.get_images()[0]


def label_of_bar(ax):
    return next(child for child in ax.child_axes).get_ylabel()


def test_scan_row_shows_delta_r_about_zero_and_r_sens_from_zero(axes):
    draw_scan_row(axes, ScanRow("F814W", [MAP, -MAP, 2.0 * MAP], SENS), GRID, 25.0, 50.0)
    for ax, factor in zip(axes[:3], (1.0, -1.0, 2.0), strict=True):
        np.testing.assert_array_equal(shown(ax).get_array(), factor * MAP)
        assert shown(ax).get_clim() == (-25.0, 25.0)
    np.testing.assert_array_equal(shown(axes[3]).get_array(), SENS)
    assert shown(axes[3]).get_clim() == (0.0, 50.0)
    assert "Delta R" in label_of_bar(axes[2])
    assert axes[0].get_ylabel() == "F814W\n$y$ [arcsec]"
    assert "sens" in label_of_bar(axes[3])


def test_amplitude_row_shows_significance_and_what_the_data_tell(axes):
    mass = np.where(SENS > 30.0, 1e8 + 1e7 * SENS, np.nan)
    draw_amplitude_row(axes, AmplitudeRow([MAP] * 3, mass, "mass [Msun]"), GRID, 5.0)
    assert all(shown(ax).get_clim() == (-5.0, 5.0) for ax in axes[:3])
    assert label_of_bar(axes[3]) == "mass [Msun]"
    np.testing.assert_array_equal(shown(axes[3]).get_array().mask, np.isnan(mass))
    low, high = shown(axes[3]).get_clim()
    assert low == np.nanmin(mass)
    assert low < high < np.nanmax(mass)


def test_amplitude_row_says_when_no_mass_would_be_seen(axes):
    draw_amplitude_row(axes, AmplitudeRow([MAP] * 3, np.full((4, 6), np.nan), "mass"), GRID, 5.0)
    assert "nothing" in axes[3].texts[0].get_text()
    assert not axes[3].child_axes


def test_plane_has_every_position_once_in_each_panel(axes):
    rng = np.random.default_rng(1)
    maps = {
        "F814W": (rng.normal(0.0, 20.0, 300), rng.lognormal(0.0, 1.0, 300)),
        "F555W": (rng.normal(3.0, 2.0, 200), rng.lognormal(1.0, 1.0, 200)),
    }
    plane, top, right, _ = axes
    draw_scan_plane(plane, top, right, maps)
    for collection, (delta, sens) in zip(plane.collections, maps.values(), strict=True):
        np.testing.assert_array_equal(collection.get_offsets(), np.column_stack([delta, sens]))
    for ax, axis in ((top, 1), (right, 0)):
        # A step outline of counts: each bin appears twice, so that its sum is twice the number of positions.
        counts = [patch.get_xy()[:, axis].sum() for patch in ax.patches]
        assert counts == [pytest.approx(2 * 300, abs=1e-9), pytest.approx(2 * 200, abs=1e-9)]
    assert plane.get_legend_handles_labels()[1][:2] == ["F814W", "F555W"]
    assert plane.get_legend() is None  # it would hide positions
    colours = [tuple(collection.get_facecolor()[0][:3]) for collection in plane.collections]
    assert colours[0] != colours[1]
    up, down = (line.get_xydata() for line in plane.lines)
    np.testing.assert_allclose(up[:, 0], up[:, 1])
    np.testing.assert_allclose(down[:, 0], -down[:, 1])
