"""Figures of the paper that need no campaign."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from warmlens.config.file import parse_config
from warmlens.config.model import Config
from warmlens.figures import halo_grid, registry
from warmlens.figures.cumulative_functions import suppress
from warmlens.figures.draw.style import house_style
from warmlens.halos.population import MASS_BINS
from warmlens.physics import geometry


@pytest.fixture(scope="module")
def coarse(paper_config: Config) -> Config:
    raw = paper_config.model_dump()
    raw["halos"]["min_mass_msun"] = 1e8
    return parse_config(raw)


@pytest.fixture(scope="module")
def masses(coarse: Config) -> np.ndarray:
    return halo_grid.read_masses(coarse)


def test_fig_1_is_drawn_with_its_data(masses: np.ndarray) -> None:
    """One scale per halo mass, the relic above each column."""
    with house_style():
        figure = halo_grid.draw_masses(masses)
        figure.canvas.draw()
    panels = [ax for ax in figure.axes if ax.images]
    assert len(panels) == 20
    np.testing.assert_array_equal(panels[7].images[0].get_array(), masses[1, 2])
    assert [ax.get_title() for ax in panels[:5]] == ["1 keV", "2 keV", "3.3 keV", "5 keV", "10 keV"]
    for row, halo_mass in zip(range(4), ("12", "12.5", "13", "13.5"), strict=True):
        (limits,) = {ax.images[0].get_clim() for ax in panels[5 * row : 5 * row + 5]}
        assert limits[1] == masses[row].max()
        assert f"{{{halo_mass}}}" in panels[5 * row].texts[0].get_text()
    plt.close(figure)
    table = halo_grid.tabulate_masses(masses)
    np.testing.assert_array_equal(table["sigma_msun_per_kpc2_3.3keV_log10m12.5"], masses[1, 2].ravel())
    assert (table["x_arcsec"].iloc[1], table["y_arcsec"].iloc[160]) == pytest.approx((-1.9625, -1.9625))
    assert table.shape == (160 * 160, 22)


def test_fig_2_shows_the_halos_of_fig_1(coarse: Config, masses: np.ndarray) -> None:
    """First component of the filtered deflection, of the very halos whose mass Fig. 1 shows."""
    deflections = halo_grid.read_deflections(coarse)
    assert "delta_alpha_1_arcsec_1keV_log10m12" in halo_grid.tabulate_deflections(deflections)
    _, lens = geometry(coarse.cosmology, coarse.redshifts)
    host, relic = 3, 4  # many subhalos
    sigma, alpha = masses[host, relic], deflections[host, relic]
    assert masses.shape == deflections.shape == (4, 5, 160, 160)
    # along x alone alpha_1 rises by twice the excess of convergence about a subhalo: at the highest peak of Sigma
    row, column = np.unravel_index(np.argmax(sigma[20:-20, 20:-20]), (120, 120))
    row, column = row + 20, column + 20
    assert alpha[row, column + 5] > 0.0 > alpha[row, column - 5]
    excess = sigma[row, column] / lens.sigma_crit_msun_kpc2
    assert 0.0 < (alpha[row, column + 2] - alpha[row, column - 2]) / (4 * 0.025) < 2.0 * excess
    with house_style():
        figure = halo_grid.draw_deflections(deflections)
    assert {ax.images[0].get_clim() for ax in figure.axes if ax.images} == {(-0.04, 0.04)}
    plt.close(figure)


def test_fig_2_needs_the_field_of_the_filter(paper_config: Config) -> None:
    raw = paper_config.model_dump()
    raw["halos"]["field_half_width_arcsec"] = 3.0
    with pytest.raises(ValueError, match=r"field_half_width_arcsec = 3 is too small"):
        halo_grid.read_deflections(parse_config(raw))


def test_fig_8_holds_five_realizations_a_model(coarse: Config, tmp_path: Path) -> None:
    registry.write_from_config("8", coarse, tmp_path / "8.png")
    assert (tmp_path / "8.png").read_bytes().startswith(b"\x89PNG")
    table = pd.read_csv(tmp_path / "8.csv")
    mass = table[table["panel"] == "mass"]
    realizations = mass[[f"n_above_realization_{number}" for number in range(1, 6)]]
    np.testing.assert_allclose(realizations.mean(axis=1), mass["n_above_mean"], rtol=1e-5)
    assert list(table["model"].unique()) == ["1 keV", "2 keV", "3.3 keV", "5 keV", "10 keV", "CDM"]
    lowest = mass[mass["m_bound_msun"] == mass["m_bound_msun"].min()].set_index("model")
    assert lowest.index.size == 6
    assert lowest["m_bound_msun"].iloc[0] == pytest.approx(1e8)
    assert lowest.loc["1 keV", "n_above_mean"] < 0.5 * lowest.loc["CDM", "n_above_mean"]
    assert lowest.loc["1 keV", "n_above_Lovell 20"] < lowest.loc["CDM", "n_above_mean"]
    assert np.isnan(lowest.loc["CDM", "n_above_Lovell 20"])


def test_suppression_acts_on_each_bin() -> None:
    cold = np.zeros(MASS_BINS.size)
    cold[:31] = 2.0  # two subhalos of 10^9 Msun
    assert MASS_BINS[30] == pytest.approx(9.0)
    halved = suppress(cold, lambda mass, _: np.where(mass > 1e9, 0.5, 1.0), 0.0)
    np.testing.assert_allclose(halved, 0.5 * cold)
    none = suppress(cold, lambda mass, _: np.ones_like(mass), 0.0)
    np.testing.assert_allclose(none, cold)
