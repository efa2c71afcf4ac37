from __future__ import annotations

import numpy as np

from warmlens.figures.draw.halo_functions import draw_cumulative_functions, model_colours

GRID = np.geomspace(1e7, 1e11, 5)
COLD = np.array([[100.0, 30.0, 9.0, 2.0, 0.0], [120.0, 34.0, 7.0, 2.0, 1.0]])
WARM = 0.1 * COLD


def test_each_line_is_what_it_says(panel):
    reference = {"Lovell+14": {"2 keV": 0.2 * COLD.mean(axis=0)}}
    draw_cumulative_functions(panel, GRID, {"2 keV": WARM, "CDM": COLD}, reference, "$m$ [M$_\\odot$]")
    lines = {line.get_label(): line for line in panel.lines if not line.get_label().startswith("_")}
    np.testing.assert_allclose(lines["CDM"].get_ydata(), COLD.mean(axis=0))
    np.testing.assert_allclose(lines["2 keV"].get_ydata(), WARM.mean(axis=0))
    assert len(panel.lines) == 2 * (2 + 1) + 1
    assert lines["CDM"].get_color() == model_colours(["2 keV", "CDM"])["CDM"]
    np.testing.assert_allclose(panel.lines[-1].get_ydata(), 0.2 * COLD.mean(axis=0))
    assert [text.get_text() for text in panel.get_legend().get_texts()] == ["2 keV", "CDM", "Lovell+14"]
    assert np.isnan(panel.lines[3].get_ydata()[-1])  # no subhalo left: no point on a logarithmic axis
    assert (panel.get_xscale(), panel.get_yscale()) == ("log", "log")
