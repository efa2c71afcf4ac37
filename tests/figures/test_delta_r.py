from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from warmlens.figures.delta_r import AmplitudeRow, draw_amplitude_row
from warmlens.figures.draw.scan import ScanRow, draw_scan_row
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


def test_r_sens_is_brightest_at_its_99_5th_percentile(axes):
    draw_scan_row(axes, ScanRow("F814W", [MAP] * 3, SENS), GRID)
    assert shown(axes[3]).get_clim() == (0.0, pytest.approx(np.percentile(SENS, 99.5)))


def test_amplitude_row_shows_significance_and_what_the_data_tell(axes):
    mass = np.where(SENS > 30.0, 1e8 + 1e7 * SENS, np.nan)
    draw_amplitude_row(axes, AmplitudeRow([MAP] * 3, mass, "mass [Msun]", ""), GRID)
    assert all(shown(ax).get_clim() == (-5.0, 5.0) for ax in axes[:3])
    assert label_of_bar(axes[3]) == "mass [Msun]"
    np.testing.assert_array_equal(shown(axes[3]).get_array().mask, np.isnan(mass))
    low, high = shown(axes[3]).get_clim()
    assert low == np.nanmin(mass)
    assert low < high < np.nanmax(mass)


def test_amplitude_row_says_when_no_mass_would_be_seen(axes):
    draw_amplitude_row(axes, AmplitudeRow([MAP] * 3, np.full((4, 6), np.nan), "mass", ""), GRID)
    assert "nothing" in axes[3].texts[0].get_text()
    assert not axes[3].child_axes
