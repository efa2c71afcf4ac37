from __future__ import annotations

import numpy as np
import pytest
from matplotlib.colors import AsinhNorm, LogNorm

from warmlens.figures.draw.sky import (
    DECADES,
    EMPTY_PEAK,
    add_colour_bar,
    brightness_limits,
    density_limits,
    draw_compass,
    draw_diverging,
    draw_halo_map,
    draw_image,
)
from warmlens.imaging.grid import PixelGrid

GRID = PixelGrid.centred((4, 6), 0.5, x=1.0)
IMAGE = np.arange(24.0).reshape(4, 6)


def drawn_at(ax, artist, x, y):
    """Value that the panel shows at a sky position, found from the transform of the artist alone."""
    column, row = (artist.get_transform() - ax.transData).inverted().transform((x, y))
    return artist.get_array()[round(row), round(column)]


@pytest.mark.parametrize("axes", [((1.0, 0.0), (0.0, 1.0)), ((-1.0, 0.0), (0.0, 1.0)), ((0.6, -0.8), (0.8, 0.6))])
def test_each_pixel_stands_where_the_grid_says(panel, axes):
    grid = PixelGrid(4, 6, 0.5, -1.0, 2.0, axes)
    artist = draw_image(panel, IMAGE, grid)
    x, y = grid.coordinates()
    for row in range(4):
        for column in range(6):
            assert drawn_at(panel, artist, x[row, column], y[row, column]) == IMAGE[row, column]
    assert panel.get_xlim()[0] < x.min() < x.max() < panel.get_xlim()[1]
    assert panel.get_ylim()[0] < y.min() < y.max() < panel.get_ylim()[1]


def test_north_up_and_west_on_the_right(panel):
    draw_image(panel, IMAGE, GRID)
    assert panel.get_xlim() == pytest.approx((-0.5, 2.5))
    assert panel.get_ylim() == pytest.approx((-1.0, 1.0))
    assert (panel.get_xlabel(), panel.get_ylabel()) == ("$x$ [arcsec]", "$y$ [arcsec]")


def test_rendered_pixels_are_upright(panel):
    image = np.zeros((4, 6))
    image[3, 5] = 1.0  # the north-western corner: top right
    draw_image(panel, image, GRID, cmap="gray")
    panel.figure.canvas.draw()
    picture = np.asarray(panel.figure.canvas.buffer_rgba())[..., 0].astype(int)
    height = picture.shape[0]
    bright = [panel.transData.transform(point) for point in ((2.25, 0.75), (-0.25, -0.75), (-0.25, 0.75))]
    values = [picture[height - 1 - round(v), round(u)] for u, v in bright]
    assert values == [255, 0, 0]


def test_stretches_and_limits(panel):
    assert draw_image(panel, IMAGE, GRID).get_clim() == (0.0, 23.0)
    asinh = draw_image(panel, IMAGE, GRID, "asinh", (-1.0, 20.0), linear_width=0.5)
    assert isinstance(asinh.norm, AsinhNorm)
    assert (asinh.norm.linear_width, *asinh.get_clim()) == (0.5, -1.0, 20.0)
    log = draw_image(panel, IMAGE, GRID, "log", (1.0, 10.0))
    assert isinstance(log.norm, LogNorm)
    assert log.norm(0.0) == 0.0  # nothing, not a hole


def test_masked_pixels_stay_masked_and_do_not_set_the_limits(panel):
    image = IMAGE.copy()
    image[0, 0] = np.nan
    artist = draw_image(panel, image, GRID)
    assert artist.get_array().mask.sum() == 1
    assert artist.get_clim() == (1.0, 23.0)


def test_diverging_map_is_centred_on_zero(panel):
    field = IMAGE - 20.0
    artist = draw_diverging(panel, field, GRID)
    assert artist.get_clim() == (-20.0, 20.0)
    red, _, blue, _ = artist.to_rgba(np.array([0.0, 20.0, -20.0])).T
    assert red[0] == pytest.approx(blue[0], abs=0.01)  # neutral at zero
    assert red[1] > blue[1]
    assert red[2] < blue[2]
    assert draw_diverging(panel, field, GRID, 0.04).get_clim() == (-0.04, 0.04)
    with pytest.raises(ValueError, match="limit"):
        draw_diverging(panel, np.zeros((4, 6)), GRID)


@pytest.mark.parametrize(
    ("limits", "extend"),
    [((0.0, 23.0), "neither"), ((1.0, 23.0), "min"), ((0.0, 20.0), "max"), ((1.0, 20.0), "both")],
)
def test_colour_bar_has_its_label_and_points_where_data_go_beyond(panel, limits, extend):
    bar = add_colour_bar(draw_image(panel, IMAGE, GRID, limits=limits), panel, "flux [e$^-$ s$^{-1}$]")
    assert bar.extend == extend
    assert bar.ax.get_ylabel() == "flux [e$^-$ s$^{-1}$]"


@pytest.mark.parametrize("stretch", ["linear", "asinh"])
def test_colour_bar_on_top_lies_above_its_panel(panel, stretch):
    bar = add_colour_bar(draw_image(panel, IMAGE, GRID, stretch), panel, "flux", "top")
    panel.figure.canvas.draw()
    assert bar.ax.get_xlabel() == "flux"
    assert bar.ax.get_window_extent().y0 > panel.get_window_extent().y1
    assert bar.ax.get_window_extent().width == pytest.approx(panel.get_window_extent().width)


def test_ticks_of_an_asinh_bar_leave_out_the_crowd_around_zero(panel):
    artist = draw_image(panel, IMAGE, GRID, "asinh", (-30.0, 200.0), linear_width=2.0)
    assert add_colour_bar(artist, panel, "flux").get_ticks().tolist() == [-10.0, 0.0, 10.0, 100.0]


def test_compass_points_north_up_and_east_left(panel):
    draw_image(panel, IMAGE, GRID)
    draw_compass(panel)
    places = {text.get_text(): text.get_position() for text in panel.texts if text.get_text()}
    assert places["N"][1] > places["E"][1]
    assert places["E"][0] < places["N"][0]


def test_image_of_another_shape_is_refused(panel):
    with pytest.raises(ValueError, match="its grid"):
        draw_image(panel, IMAGE.T, GRID)


def test_halo_map_spans_three_decades(panel):
    sigma = np.where(IMAGE > 0.0, IMAGE * 1e6, 0.0)
    artist = draw_halo_map(panel, sigma, GRID)
    assert artist.get_clim() == pytest.approx((2.3e4, 2.3e7))
    np.testing.assert_array_equal(artist.get_array(), sigma)
    assert density_limits([np.zeros((4, 6))]) == (EMPTY_PEAK / 10**DECADES, EMPTY_PEAK)  # no subhalo
    with pytest.raises(ValueError, match="must be finite"):
        density_limits([np.full((4, 6), np.nan)])


def test_brightness_starts_at_zero_or_below_and_leaves_out_the_brightest():
    image = np.append(np.linspace(1.0, 2.0, 999), [1e6, np.nan])
    low, high = brightness_limits(image)
    assert low == 0.0
    assert 1.9 < high < 10.0
    assert brightness_limits(image - 1.5)[0] < 0.0
