from __future__ import annotations

import numpy as np
import pytest
from matplotlib.path import Path
from warmlens.figures.draw.posterior import draw_mass_marginal, draw_posterior_plane

from warmlens.inference.bound import Bound

M_RANGE, LOG_RANGE = (1.0, 5.0), (13.0, 13.5)


def table(n, n_accepted, seed=0):
    """The accepted ones crowd in the corner of high masses."""
    rng = np.random.default_rng(seed)
    m, log10_mass = rng.uniform(*M_RANGE, n), rng.uniform(*LOG_RANGE, n)
    accepted = np.zeros(n, dtype=bool)
    accepted[np.argsort(-m / 4.0 - log10_mass / 0.5 + rng.normal(0, 0.3, n))[:n_accepted]] = True
    return m, log10_mass, accepted


def bound_of(k):
    return Bound("q0455", 0.0455, 2.7, 0.08, 1.182, k, 20 * k, float(k), ())


def inside(contours, level, points):
    """Which points lie in the filled regions from `level` on."""
    found = np.zeros(len(points), dtype=bool)
    for path in contours.get_paths()[level:]:
        for polygon in path.to_polygons():
            found ^= Path(polygon).contains_points(points)
    return found


@pytest.mark.parametrize("n_accepted", [60, 3000])
def test_regions_hold_their_share_of_the_accepted_samples(panel, n_accepted):
    m, log10_mass, accepted = table(20 * n_accepted, n_accepted)
    contours = draw_posterior_plane(panel, m, log10_mass, accepted, M_RANGE, LOG_RANGE)
    points = np.column_stack([m, log10_mass])[accepted]
    tolerance = 0.12 if n_accepted == 60 else 0.03
    assert inside(contours, 1, points).mean() == pytest.approx(0.683, abs=tolerance)
    assert inside(contours, 0, points).mean() == pytest.approx(0.954, abs=tolerance)


def test_points_are_all_and_the_accepted(panel):
    m, log10_mass, accepted = table(400, 40)
    draw_posterior_plane(panel, m, log10_mass, accepted, M_RANGE, LOG_RANGE)
    offsets = [c.get_offsets() for c in panel.collections if c.get_label().startswith(("all", "accepted"))]
    np.testing.assert_allclose(offsets[0], np.column_stack([m, log10_mass]))
    np.testing.assert_allclose(offsets[1], np.column_stack([m, log10_mass])[accepted])
    assert (panel.get_xlim(), panel.get_ylim()) == (M_RANGE, LOG_RANGE)
    labels = [text.get_text() for text in panel.get_legend().get_texts()]
    assert sorted(labels) == ["68.3%", "95.4%", "accepted 40", "all 400"]


def test_too_few_accepted_are_points_and_a_note(panel):
    m, log10_mass, accepted = table(200, 10)
    assert draw_posterior_plane(panel, m, log10_mass, accepted, M_RANGE, LOG_RANGE) is None
    assert [text.get_text() for text in panel.texts] == ["10 accepted: too few for a density"]
    assert len(panel.collections) == 2


def test_weights_move_the_regions(panel):
    rng = np.random.default_rng(4)
    m, log10_mass = rng.uniform(*M_RANGE, 3000), rng.uniform(*LOG_RANGE, 3000)
    weights = np.where(m > 3.0, 1.0, 1e-3)
    contours = draw_posterior_plane(panel, m, log10_mass, np.ones(3000, dtype=bool), M_RANGE, LOG_RANGE, weights)
    assert inside(contours, 1, np.column_stack([m, log10_mass])[m < 2.5]).sum() == 0


@pytest.mark.parametrize("k", [10, 124, 3000])
def test_marginal_shades_what_the_bound_excludes(panel, k):
    m = np.random.default_rng(5).triangular(2.0, 4.8, 5.0, k)
    draw_mass_marginal(panel, m, bound_of(k), M_RANGE)
    bars = panel.containers[0]
    widths = np.array([bar.get_width() for bar in bars])
    heights = np.array([bar.get_height() for bar in bars])
    assert (widths * heights).sum() == pytest.approx(1.0)
    shaded = panel.patches[-1]
    assert (shaded.get_x(), shaded.get_x() + shaded.get_width()) == pytest.approx((1.0, 2.7))
    vertical = {line.get_linestyle(): line.get_xdata()[0] for line in panel.lines if len(line.get_xdata()) == 2}
    assert vertical == {"-": 2.7, "--": 1.182}
    labels = " ".join(text.get_text() for text in panel.get_legend().get_texts())
    assert ["2.70 \\pm 0.08" in labels, "95.45%" in labels, "1.18 keV" in labels] == [True] * 3
    curves = [line for line in panel.lines if len(line.get_xdata()) > 2]
    if k < 20:
        assert not curves
        assert panel.texts[0].get_text() == "10 accepted: too few for a density"
    else:
        (curve,) = curves
        assert np.trapezoid(curve.get_ydata(), curve.get_xdata()) == pytest.approx(1.0, abs=0.01)
        assert curve.get_xdata().max() <= 5.0


def test_marginal_of_uniform_samples_stays_up_at_the_edges(panel):
    """A density that leaks over the edge of the prior would fall to one half there."""
    draw_mass_marginal(panel, np.random.default_rng(6).uniform(*M_RANGE, 4000), bound_of(4000), M_RANGE)
    (curve,) = [line for line in panel.lines if len(line.get_xdata()) > 2]
    assert curve.get_ydata()[[0, -1]] == pytest.approx(0.25, rel=0.2)


def test_nothing_is_printed(panel, capsys):
    draw_mass_marginal(panel, np.linspace(2, 5, 100), bound_of(100), M_RANGE)
    assert capsys.readouterr().out == ""
