from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.patches import Circle, Rectangle

from warmlens.figures.draw.sample import MARKED, draw_summary, mark_subhalos
from warmlens.imaging.grid import PixelGrid


def test_summary_shows_sample_and_observation_over_the_accepted() -> None:
    grid = np.linspace(0.0, 2.0, 5)
    observed, sample = np.array([1.0, 1e-2, 1e-17, 1e-2, 1e-2]), np.full(5, 2e-2)
    accepted = np.outer(np.array([0.5, 0.8, 1.0, 1.2, 1.5]), observed)
    _, ax = plt.subplots()
    draw_summary(ax, grid, accepted, observed, sample)
    lines = {line.get_label(): line.get_ydata() for line in ax.lines}
    np.testing.assert_array_equal(lines["observation"], observed)
    np.testing.assert_array_equal(lines["this sample"], sample)
    assert ax.yaxis.get_transform().linthresh == pytest.approx(1e-2), "rounding does not stretch the ordinate"
    _, ax = plt.subplots()
    draw_summary(ax, grid, accepted, observed, None)
    assert "this sample" not in {line.get_label() for line in ax.lines}


def test_heaviest_subhalos_are_circled_by_mass() -> None:
    rng = np.random.default_rng(3)
    mass = rng.permutation(np.geomspace(1e7, 1e10, 2 * MARKED))
    x, y = rng.uniform(-2.0, 2.0, (2, mass.size))
    _, ax = plt.subplots()
    mark_subhalos(ax, x, y, mass, PixelGrid.centred((40, 60), 0.1))
    circles = [patch for patch in ax.patches if isinstance(patch, Circle)]
    heaviest = np.argsort(mass)[::-1][:MARKED]
    assert [circle.center for circle in circles] == [(x[i], y[i]) for i in heaviest]
    ratio = circles[0].radius / circles[-1].radius
    assert ratio == pytest.approx(np.cbrt(mass[heaviest[0]] / mass[heaviest[-1]]))
    (frame,) = (patch for patch in ax.patches if isinstance(patch, Rectangle))
    assert (frame.get_width(), frame.get_height()) == pytest.approx((6.0, 4.0))
