from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from warmlens.config import Config
from warmlens.config_file import parse_config
from warmlens.halos.whole_halo import MASS_BINS
from warmlens.stages import paper_figures
from warmlens.stages.halos import geometry


@pytest.fixture(scope="module")
def coarse(paper_config: Config) -> Config:
    raw = paper_config.model_dump()
    raw["halos"]["min_mass_msun"] = 1e8
    return parse_config(raw)


@pytest.mark.parametrize("name", ["1", "2", "8"])
def test_figures_of_the_paper(coarse: Config, tmp_path: Path, name: str) -> None:
    paper_figures.run(name, coarse, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in tmp_path.iterdir()] == ["figure.png"]


def test_figure_2_shows_the_haloes_of_figure_1(coarse: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    """First component of the filtered deflection on its scale, of the very haloes whose mass Fig. 1 shows."""
    drawn = {}
    monkeypatch.setattr(paper_figures, "draw_halo_grid", lambda axes, maps, *rest: drawn.update({"1": maps}))
    monkeypatch.setattr(
        paper_figures, "draw_deflection_grid", lambda axes, maps, *rest: drawn.update({"2": maps, "rest": rest})
    )
    plt.close(paper_figures._halo_grid(coarse))
    plt.close(paper_figures._deflection_grid(coarse))
    assert drawn["rest"][-1] == 0.04
    _, lens = geometry(coarse.cosmology, coarse.redshifts)
    host, relic = 3, 4  # many subhaloes
    sigma, alpha = np.array(drawn["1"][host][relic]), np.array(drawn["2"][host][relic])
    assert np.shape(drawn["1"]) == np.shape(drawn["2"]) == (4, 5, 160, 160)
    # along x alone alpha_1 rises by twice the excess of convergence about a subhalo: at the highest peak of Sigma
    row, column = np.unravel_index(np.argmax(sigma[20:-20, 20:-20]), (120, 120))
    row, column = row + 20, column + 20
    assert alpha[row, column + 5] > 0.0 > alpha[row, column - 5]
    excess = sigma[row, column] / lens.sigma_crit_msun_kpc2
    assert 0.0 < (alpha[row, column + 2] - alpha[row, column - 2]) / (4 * 0.025) < 2.0 * excess


def test_figure_2_needs_the_field_of_the_filter(paper_config: Config) -> None:
    raw = paper_config.model_dump()
    raw["halos"]["field_half_width_arcsec"] = 3.0
    with pytest.raises(ValueError, match=r"field_half_width_arcsec = 3 is too small"):
        paper_figures._deflection_grid(parse_config(raw))


def test_suppression_acts_on_each_bin() -> None:
    cold = np.zeros(MASS_BINS.size)
    cold[:31] = 2.0  # two subhaloes of 10^9 Msun
    assert MASS_BINS[30] == pytest.approx(9.0)
    halved = paper_figures._suppressed(cold, lambda mass, _: np.where(mass > 1e9, 0.5, 1.0), 0.0)
    np.testing.assert_allclose(halved, 0.5 * cold)
    none = paper_figures._suppressed(cold, lambda mass, _: np.ones_like(mass), 0.0)
    np.testing.assert_allclose(none, cold)
