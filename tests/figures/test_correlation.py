from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from warmlens.figures.correlation import draw, draw_terciles
from warmlens.figures.draw.style import house_style
from warmlens.figures.samples import Summaries, split_by_value

GRID = np.linspace(0.0, 2.5, 6)
KINDS = ("correlation", "cumulative")


def summaries(m, samples, observed) -> Summaries:
    return Summaries(
        dict.fromkeys(KINDS, GRID),
        dict.fromkeys(KINDS, samples),
        dict.fromkeys(KINDS, observed),
        pd.DataFrame({"m_th_kev": m}),
    )


@pytest.fixture
def data():
    rng = np.random.default_rng(0)
    m = rng.uniform(1.0, 5.0, 31)
    return summaries(m, m[:, None] * rng.uniform(0.5, 2.0, (31, 6)), np.linspace(9.0, 1.0, 6))


def terciles(m):
    edges = np.sort(m)
    return [m <= edges[10], (m > edges[10]) & (m <= edges[20]), m > edges[20]]


@pytest.mark.parametrize("kind", KINDS)
def test_lines_are_the_means_of_the_terciles_and_the_observation(panel, data, kind):
    draw_terciles(panel, data, kind)
    *means, last = panel.get_lines()
    for line, group in zip(means, terciles(data.parameters["m_th_kev"].to_numpy()), strict=True):
        np.testing.assert_allclose(line.get_xdata(), GRID)
        np.testing.assert_allclose(line.get_ydata(), data.samples[kind][group].mean(axis=0))
    np.testing.assert_array_equal(last.get_ydata(), data.observed[kind])
    assert last.get_color() == "black"
    assert last.get_linewidth() > means[0].get_linewidth()
    assert panel.get_yscale() == "symlog"
    assert panel.get_ylim()[0] == 0.0


def test_both_summaries_have_a_panel_with_labels(data):
    with house_style():
        figure = draw(data)
    assert [ax.get_xlabel() for ax in figure.axes] == [r"${\rm d}r$ [arcsec]", r"$\Delta R$"]
    assert [ax.get_ylabel()[:13] for ax in figure.axes] == [r"$C({\rm d}r) ", "fraction of p"]
    plt.close(figure)


def test_bands_are_the_percentiles(panel, data):
    draw_terciles(panel, data, "correlation")
    groups = terciles(data.parameters["m_th_kev"].to_numpy())
    for band, group in zip(panel.collections, groups, strict=True):
        vertices = band.get_paths()[0].vertices
        at_zero = vertices[vertices[:, 0] == 0.0, 1]
        expected = np.percentile(data.samples["correlation"][group, 0], [16, 84])
        np.testing.assert_allclose([at_zero.min(), at_zero.max()], expected)


def test_labels_name_the_masses_of_the_groups(panel):
    m = np.array([1.0, 1.5, 2.0, 3.0, 4.0, 5.0])
    draw_terciles(panel, summaries(m, np.ones((6, 6)), np.ones(6)), "correlation")
    labels = [text.get_text() for text in panel.get_legend().get_texts()]
    assert ["1.0" in labels[0], "1.5" in labels[0], "4.0" in labels[2], "5.0" in labels[2]] == [True] * 4
    assert labels[-1] == "observation"


def test_nothing_anywhere_is_drawn_on_a_linear_scale(panel):
    draw_terciles(panel, summaries(np.linspace(1, 5, 6), np.zeros((6, 6)), np.zeros(6)), "correlation")
    assert panel.get_yscale() == "linear"


def test_groups_cover_the_table_once():
    m = np.random.default_rng(1).uniform(1, 5, 20)
    groups = split_by_value(m, 3)
    assert sorted(np.concatenate(groups)) == list(range(20))
    assert sorted(len(rows) for rows in groups) == [6, 7, 7]
    with pytest.raises(ValueError, match="n_groups"):
        split_by_value(m, 21)
