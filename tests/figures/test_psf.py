from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from warmlens.figures.draw.style import house_style
from warmlens.figures.psf import PsfRow, draw, draw_profiles, draw_psf_row, radial_profile
from warmlens.imaging.psf import hst_like_psf

GIVEN = hst_like_psf(814.0, 0.05, 41)
IMPROVED = hst_like_psf(814.0, 0.05, 41, blur_arcsec=0.04)
ERROR = (np.array([0.05, 0.1, 0.15]), np.array([1e-3, 0.0, 1e-4]))


def test_profile_of_a_round_kernel():
    axis = np.arange(-10, 11) * 0.1
    radius, mean = radial_profile(1.0 - 0.3 * np.hypot(axis[:, None], axis[None, :]), 0.1)
    assert radius[0] == 0.0
    assert radius.size == 11
    np.testing.assert_allclose(mean, 1.0 - 0.3 * radius)


def test_changed_and_unchanged_rows_of_one_figure():
    rows = [PsfRow("F814W", GIVEN, IMPROVED, 0.05, ERROR), PsfRow("F555W", GIVEN, GIVEN, 0.05)]
    assert [row.changed for row in rows] == [True, False]
    with house_style():
        figure, axes = plt.subplots(2, 4, figsize=(7.2, 4.7))
        for panels, row in zip(axes, rows, strict=True):
            draw_psf_row(panels, row)
        figure.canvas.draw()
    labels = [[ax.child_axes[0].get_xlabel() for ax in row if ax.child_axes] for row in axes]
    assert [label.split(" [")[0] for label in labels[0]] == ["given PSF", "improved PSF", "difference"]
    assert [label.split(" [")[0] for label in labels[1]] == ["PSF as given"]
    assert [ax.figure is not None for ax in axes[1]] == [True, False, False, True]
    np.testing.assert_allclose(axes[0, 2].images[0].get_array(), 1e3 * (IMPROVED - GIVEN))
    assert axes[0, 0].images[0].get_clim() == axes[0, 1].images[0].get_clim()
    low, high = axes[0, 2].images[0].get_clim()
    assert low == -high
    plt.close(figure)


@pytest.mark.parametrize("others", [[], [PsfRow("F555W", GIVEN, IMPROVED, 0.05)]])
def test_kernel_smaller_than_the_window_is_shown_whole(others):
    """In a figure of two columns, or of four if the PSF of another band was changed."""
    small = GIVEN[15:-15, 15:-15]
    with house_style():
        figure = draw([PsfRow("F814W", small, small, 0.05), *others])
        figure.canvas.draw()
    assert figure.axes[0].images[0].get_array().shape == (11, 11)
    assert len(figure.axes) == 2 + 4 * len(others)
    plt.close(figure)


def test_profiles_name_what_they_are(panel):
    draw_profiles(panel, PsfRow("F814W", GIVEN, IMPROVED, 0.05, ERROR))
    _, labels = panel.get_legend_handles_labels()
    assert set(labels) == {"given", "improved", "rms change", "error left"}
    assert panel.get_yscale() == "log"


def test_unchanged_profile_says_as_given(panel):
    draw_profiles(panel, PsfRow("F814W", GIVEN, GIVEN, 0.05))
    assert panel.get_legend_handles_labels()[1] == ["as given"]
