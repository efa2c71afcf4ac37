from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer

from warmlens.figures.draw.systematics import draw_bounds, draw_scans, line_heights
from warmlens.systematics.table import FAILED, Row

ROWS = [
    Row("base", "base", "", bound_kev=2.0, mc_error_kev=0.2, prior_only_kev=1.18, n_below=44),
    Row("broken", "lens", "", FAILED, "chi2_red"),
    Row("scanned", "lens", "", n_below=80),
    Row("other", "halos", "", bound_kev=1.5, mc_error_kev=0.3, prior_only_kev=1.2, n_below=0),
]


def test_groups_are_set_off() -> None:
    assert line_heights([row.group for row in ROWS]) == [-1.0, -3.0, -4.0, -6.0]


def test_bounds_with_errors_beside_the_prior(panel: Axes) -> None:
    draw_bounds(panel, ROWS)
    bars = [bar for bar in panel.containers if isinstance(bar, ErrorbarContainer)]
    assert [(bar[0].get_xdata()[0], bar[0].get_ydata()[0]) for bar in bars] == [(2.0, -1.0), (1.5, -6.0)]
    ends = [np.ptp(bar[2][0].get_segments()[0][:, 0]) for bar in bars]
    assert np.allclose(ends, [0.4, 0.6])
    ticks = [line for line in panel.lines if line.get_color() == "black" and len(line.get_xdata())]
    assert [(line.get_xdata()[0], line.get_ydata()[0]) for line in ticks] == [(1.18, -1.0), (1.2, -6.0)]
    notes = {text.get_text(): text.xy[1] for text in panel.texts}
    assert notes == {"failed": -3.0, "scan only": -4.0, "lens": -2.1, "halos": -5.1}
    assert [label.get_text() for label in panel.get_yticklabels()] == [row.name for row in ROWS]
    assert np.isclose(panel.patches[0].get_x(), 1.8)  # the base's band


def test_scans(panel: Axes) -> None:
    draw_scans(panel, ROWS)
    drawn = panel.lines[-1]
    assert list(drawn.get_xdata()) == [44, 80, 0]
    assert list(drawn.get_ydata()) == [-1.0, -4.0, -6.0]
    assert panel.get_xlim()[1] > 80
    assert panel.get_legend() is None


def test_scans_beside_mocks_without_substructure(panel: Axes) -> None:
    draw_scans(panel, [replace(ROWS[0], null_n_below=90.5), *ROWS[1:]])
    null = panel.lines[-1]
    assert (list(null.get_xdata()), list(null.get_ydata())) == ([90.5], [-1.0])
    assert panel.get_xlim()[1] > 90.5
    assert [text.get_text() for text in panel.get_legend().get_texts()] == ["observation", "null mocks"]
