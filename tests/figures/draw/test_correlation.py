from __future__ import annotations

import numpy as np
import pytest
from warmlens.figures.draw.correlation import draw_correlations, draw_cumulatives, group_by_mass

GRID = np.linspace(0.0, 2.5, 6)


@pytest.fixture
def table():
    rng = np.random.default_rng(0)
    m = rng.uniform(1.0, 5.0, 31)
    return m, m[:, None] * rng.uniform(0.5, 2.0, (31, 6)), np.linspace(9.0, 1.0, 6)


@pytest.mark.parametrize("draw", [draw_correlations, draw_cumulatives])
def test_lines_are_the_means_of_the_terciles_and_the_observation(panel, table, draw):
    m, samples, observed = table
    draw(panel, GRID, samples, m, observed)
    *means, last = panel.get_lines()
    edges = np.sort(m)
    groups = [m <= edges[10], (m > edges[10]) & (m <= edges[20]), m > edges[20]]
    assert len(means) == 3
    for line, group in zip(means, groups, strict=True):
        np.testing.assert_allclose(line.get_xdata(), GRID)
        np.testing.assert_allclose(line.get_ydata(), samples[group].mean(axis=0))
    np.testing.assert_array_equal(last.get_ydata(), observed)
    assert last.get_color() == "black"
    assert last.get_linewidth() > means[0].get_linewidth()
    assert panel.get_yscale() == "symlog"
    assert panel.get_ylim()[0] == 0.0


def test_bands_are_the_percentiles(panel, table):
    m, samples, observed = table
    draw_correlations(panel, GRID, samples, m, observed, n_groups=1)
    (band,) = panel.collections
    vertices = band.get_paths()[0].vertices
    at_zero = vertices[vertices[:, 0] == 0.0, 1]
    np.testing.assert_allclose([at_zero.min(), at_zero.max()], np.percentile(samples[:, 0], [16, 84]))


def test_labels_name_the_masses_of_the_groups(panel):
    m = np.array([1.0, 1.5, 2.0, 3.0, 4.0, 5.0])
    draw_correlations(panel, GRID, np.ones((6, 6)), m, np.ones(6))
    labels = [text.get_text() for text in panel.get_legend().get_texts()]
    assert ["1.0" in labels[0], "1.5" in labels[0], "4.0" in labels[2], "5.0" in labels[2]] == [True] * 4
    assert labels[-1] == "observation"


def test_nothing_anywhere_is_drawn_on_a_linear_scale(panel):
    draw_correlations(panel, GRID, np.zeros((6, 6)), np.linspace(1, 5, 6), np.zeros(6))
    assert panel.get_yscale() == "linear"


def test_groups_cover_the_table_once():
    m = np.random.default_rng(1).uniform(1, 5, 20)
    groups = group_by_mass(m, 3)
    assert sorted(np.concatenate(groups)) == list(range(20))
    assert sorted(len(rows) for rows in groups) == [6, 7, 7]
    with pytest.raises(ValueError, match="n_groups"):
        group_by_mass(m, 21)
