from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from matplotlib.path import Path

from warmlens.figures.posterior import PosteriorFigure, draw_mass_marginal, draw_posterior_plane

M_RANGE, LOG_RANGE = (1.0, 5.0), (13.0, 13.5)


BOUND = {"level": 0.0455, "value_kev": 2.7, "mc_error_kev": 0.08, "prior_only_kev": 1.182}


def posterior(m, log10_mass, accepted) -> PosteriorFigure:
    samples = pd.DataFrame({"m_th_kev": m, "log10_m_halo_msun": log10_mass, "accepted": accepted})
    return PosteriorFigure(samples, BOUND, M_RANGE, LOG_RANGE)


def corner(n, n_accepted) -> PosteriorFigure:
    """The accepted ones crowd in the corner of high masses."""
    rng = np.random.default_rng(0)
    m, log10_mass = rng.uniform(*M_RANGE, n), rng.uniform(*LOG_RANGE, n)
    accepted = np.zeros(n, dtype=bool)
    accepted[np.argsort(-m / 4.0 - log10_mass / 0.5 + rng.normal(0, 0.3, n))[:n_accepted]] = True
    return posterior(m, log10_mass, accepted)


def marginal(m) -> PosteriorFigure:
    return posterior(m, np.full(m.size, 13.2), np.ones(m.size, dtype=bool))


def inside(contours, level, points):
    """Which points lie in the filled regions from `level` on."""
    covered = np.zeros(len(points), dtype=bool)
    for path in contours.get_paths()[level:]:
        for polygon in path.to_polygons():
            covered ^= Path(polygon).contains_points(points)
    return covered


@pytest.mark.parametrize("n_accepted", [60, 3000])
def test_regions_hold_their_share_of_the_accepted_samples(panel, n_accepted):
    data = corner(20 * n_accepted, n_accepted)
    contours = draw_posterior_plane(panel, data)
    points = data.accepted[["m_th_kev", "log10_m_halo_msun"]].to_numpy()
    tolerance = 0.12 if n_accepted == 60 else 0.03
    assert inside(contours, 1, points).mean() == pytest.approx(0.683, abs=tolerance)
    assert inside(contours, 0, points).mean() == pytest.approx(0.954, abs=tolerance)


def test_points_are_all_and_the_accepted(panel):
    data = corner(400, 40)
    draw_posterior_plane(panel, data)
    offsets = [c.get_offsets() for c in panel.collections if c.get_label().startswith(("all", "accepted"))]
    for shown, samples in zip(offsets, (data.samples, data.accepted), strict=True):
        np.testing.assert_allclose(shown, samples[["m_th_kev", "log10_m_halo_msun"]])
    assert (panel.get_xlim(), panel.get_ylim()) == (M_RANGE, LOG_RANGE)
    labels = [text.get_text() for text in panel.get_legend().get_texts()]
    assert sorted(labels) == ["68.3%", "95.4%", "accepted 40", "all 400"]


def test_too_few_accepted_are_points_and_a_note(panel):
    assert draw_posterior_plane(panel, corner(200, 10)) is None
    assert [text.get_text() for text in panel.texts] == ["10 accepted: too few for a density"]
    assert len(panel.collections) == 2


@pytest.mark.parametrize("k", [10, 124, 3000])
def test_marginal_shades_what_the_bound_excludes(panel, k):
    m = np.random.default_rng(5).triangular(2.0, 4.8, 5.0, k)
    draw_mass_marginal(panel, marginal(m))
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
    draw_mass_marginal(panel, marginal(np.random.default_rng(6).uniform(*M_RANGE, 4000)))
    (curve,) = [line for line in panel.lines if len(line.get_xdata()) > 2]
    assert curve.get_ydata()[[0, -1]] == pytest.approx(0.25, rel=0.2)


def test_nothing_is_printed(panel, capsys):
    draw_mass_marginal(panel, marginal(np.linspace(2, 5, 100)))
    assert capsys.readouterr().out == ""
