"""Figures of images and maps hold the arrays of the artifacts on their grids."""

from __future__ import annotations

from collections.abc import Callable

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from warmlens.artifacts.file import open_artifact
from warmlens.campaign.derived import figure_inputs
from warmlens.campaign.files import stage_files
from warmlens.config.model import Config
from warmlens.figures.draw.style import house_style
from warmlens.figures.halo_maps import SampleMaps, draw_deflections, draw_masses, read_masses, tabulate
from warmlens.figures.psf import radial_profile
from warmlens.figures.recipe import map_table
from warmlens.figures.samples import Sample
from warmlens.imaging.grid import PixelGrid
from warmlens.products.halos import read_subhalos
from warmlens.products.observation import read_observation
from warmlens.products.smooth_model import read_smooth_model

Tables = Callable[[str], pd.DataFrame]


def test_maps_become_columns_beside_positions_and_blank_pixels_go() -> None:
    grid = PixelGrid(2, 2, 0.5, 1.0, -1.0, ((0.0, 1.0), (1.0, 0.0)))  # columns run along y
    maps = {"a": np.array([[1.0, np.nan], [3.0, np.nan]]), "b": np.array([[5.0, 6.0], [7.0, np.nan]])}
    table = map_table(grid, maps)
    expected = [[1.0, -1.0, 1.0, 5.0], [1.0, -0.5, np.nan, 6.0], [1.5, -1.0, 3.0, 7.0]]
    np.testing.assert_array_equal(table[["x_arcsec", "y_arcsec", "a", "b"]], expected)


def test_smooth_model_has_data_model_residual_and_source(campaign: Config, table_of: Tables) -> None:
    table = table_of("smooth_model")
    observed = read_observation(stage_files(campaign, "observation")[0])
    model = read_smooth_model(stage_files(campaign, "smooth_model")[0])
    image = table[table["panel"] == "image"]
    for band in observed.bands:
        fit = model.fits[band.name]
        used = (band.mask & np.isfinite(fit.sigma)).ravel()
        shown = {key: image[f"{band.name}_{key}"] for key in ("data_electron_per_s", "residual_sigma")}
        np.testing.assert_allclose(shown["data_electron_per_s"], band.image[band.mask], rtol=1e-5)
        residual = ((band.image - fit.model) / np.where(np.isfinite(fit.sigma), fit.sigma, 1.0)).ravel()[used]
        np.testing.assert_allclose(shown["residual_sigma"].dropna(), residual, rtol=1e-4, atol=1e-5)
    source = table[table["panel"] == "source"]
    assert source["F814W_source_electron_per_s_arcsec2"].notna().all()
    assert source["F814W_data_electron_per_s"].isna().all()


def test_psf_has_profiles_and_kernels(campaign: Config, table_of: Tables) -> None:
    table = table_of("psf")
    observed = read_observation(stage_files(campaign, "observation")[0])
    for band in observed.bands:
        radius, profile = radial_profile(band.psf, observed.grid.pixel_scale)
        shown = table[table["panel"] == f"{band.name} profile"]
        np.testing.assert_allclose(shown["radius_arcsec"], radius, rtol=1e-5)
        np.testing.assert_allclose(shown["given_per_px"], profile, rtol=1e-5)
        kernel = table[table["panel"] == f"{band.name} kernel"]
        np.testing.assert_allclose(kernel["improved_per_px"], band.psf.ravel(), rtol=1e-5)  # as given: not changed


def test_mocks_are_the_coldest_of_the_chunk(campaign: Config, table_of: Tables) -> None:
    table = table_of("mocks")
    with open_artifact(stage_files(campaign, "mocks")[0]) as artifact:
        row = int(np.argmax(artifact.array("samples/m_th_kev")))
        mock = artifact.array("F555W/image")[row]
    model = read_smooth_model(stage_files(campaign, "smooth_model")[0])
    np.testing.assert_allclose(table[f"F555W_sample_{row}_electron_per_s"], mock.ravel(), rtol=1e-5)
    fit = model.fits["F555W"]
    residual = (mock.astype(float) - fit.model) / fit.sigma
    np.testing.assert_allclose(table[f"F555W_sample_{row}_residual_sigma"], residual.ravel(), rtol=1e-4, atol=1e-5)


def test_deflections_are_those_of_the_artifact(campaign: Config, table_of: Tables) -> None:
    table = table_of("deflection_maps")
    grid = read_observation(stage_files(campaign, "observation")[0]).grid
    x, y = grid.coordinates()
    np.testing.assert_allclose(table[["x_arcsec", "y_arcsec"]].T, [x.ravel(), y.ravel()], atol=1e-5)
    with open_artifact(stage_files(campaign, "deflections")[0]) as artifact:
        delta, m_th = artifact.array("delta_alpha"), artifact.array("samples/m_th_kev")
    columns = [name for name in table if name.startswith("sample_")]
    rows = [int(name.split("_")[1]) for name in columns]
    assert len(rows) == 6
    assert m_th[rows].tolist() == sorted(m_th[rows])
    for name, row in zip(columns, rows, strict=True):
        np.testing.assert_allclose(table[name], delta[row, 0].ravel(), rtol=1e-4, atol=1e-9)


def test_projected_mass_is_that_of_the_subhalos(campaign: Config) -> None:
    """The mass in the field is at most that of the subhalos, and peaks at one of them."""
    data = read_masses(figure_inputs(campaign, "halo_maps"))
    sample, sigma = data.samples[-1], data.maps[-1]
    with open_artifact(stage_files(campaign, "halos")[0]) as artifact:
        subhalos = read_subhalos(artifact, sample.row)
    x, y = data.grid.coordinates()
    peak = np.unravel_index(np.argmax(sigma), sigma.shape)
    distance = np.hypot(subhalos.x_arcsec - x[peak], subhalos.y_arcsec - y[peak])
    assert distance.min() < data.grid.pixel_scale
    kpc = 4.4 * data.grid.pixel_scale  # kpc of an arcsec at the lens, to 1%
    assert 0.0 < sigma.sum() * kpc**2 < 1.05 * subhalos.m_bound.sum()


def test_fewer_samples_than_panels(campaign: Config) -> None:
    data = read_masses(figure_inputs(campaign, "halo_maps"))
    fewer = SampleMaps(data.maps[:2], data.samples[:2], data.grid, data.quantity)
    with house_style():
        figure = draw_masses(fewer)
        figure.canvas.draw()
    assert len([ax for ax in figure.axes if ax.images]) == 2
    assert list(tabulate(fewer).columns[2:]) == [
        f"sample_{sample.sample_id}_sigma_msun_per_kpc2" for sample in data.samples[:2]
    ]


@pytest.mark.parametrize(("draw", "unit"), [(draw_masses, "kpc"), (draw_deflections, "arcsec")])
def test_panels_share_a_scale_and_carry_their_titles(draw: Callable[[SampleMaps], Figure], unit: str) -> None:
    image = np.arange(24.0).reshape(4, 6)
    samples = tuple(Sample(number, number, 1.0 + number, 13.0) for number in range(6))
    data = SampleMaps(tuple(image * (1 + n) for n in range(6)), samples, PixelGrid.centred((4, 6), 0.5), "")
    with house_style():
        figure = draw(data)
        figure.canvas.draw()
    *panels, bar = figure.axes
    assert len(panels) == 6
    for ax, sample, values in zip(panels, samples, data.maps, strict=True):
        assert ax.get_title() == sample.label
        np.testing.assert_array_equal(ax.images[0].get_array(), values)
    assert len({ax.images[0].get_clim() for ax in panels}) == 1
    assert unit in bar.get_ylabel()
    plt.close(figure)
