"""Stages of the scan: files that are not this campaign's are refused by name; macro columns; windows."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Dataset, open_artifact
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.config.model import CosmologyBlock, RedshiftBlock
from warmlens.config.scan import ScanBlock
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.observation import Band, Observation
from warmlens.imaging.psf import point_source
from warmlens.products.scan_maps import read_response
from warmlens.scan.raster import Raster
from warmlens.stage_table import ScanSettings
from warmlens.stages import scan_operator
from warmlens.stages import scanner as scanning
from warmlens.stages.job import make_job, run_job
from warmlens.stages.scanner import Scanner

from ..shared import run_stage

BLOCK = {
    "perturber": {"theta_e_arcsec": 0.01, "r_trunc_arcsec": 0.1},
    "nested": {"n_max": 2, "ridge": 1e-5, "beta_range_arcsec": [0.02, 0.1]},
    "step_arcsec": 0.3,
    "window_arcsec": [1.2, 1.2],
    "center": [0.0, 0.0],
    "shard_size": 8,
}
SPANS = ((0, 8), (8, 16))


def settings_of(**changes):
    return ScanSettings(scan=ScanBlock.model_validate({**BLOCK, **changes}))


@pytest.fixture
def campaign(band, mocks, tmp_path, monkeypatch):
    """Files of a campaign of one band; observation and smooth model are in memory, their files only digests."""
    sigma = np.where(band.weights > 0, 1.0 / np.maximum(band.weights, 1.0), np.inf)
    item = Band("F814W", mocks[0], sigma, band.weights > 0, band.convolution.psf, NoiseModel(0.01, 1000.0))
    observation = Observation("simulated", band.grid, (item,))
    quasar = point_source(item.psf, band.grid, 0.5, 0.1).ravel()
    rng = np.random.default_rng(2)
    model = SimpleNamespace(
        fits={"F814W": SimpleNamespace(sigma=sigma, psf=item.psf)},
        sets=band.sets,
        rays=band.rays,
        ridge=1e-8,
        fixed={"F814W": np.stack([quasar, np.ones(quasar.size)], axis=1)},
        macro={"F814W": rng.normal(size=(quasar.size, 2))},
        macro_sigma=np.array([1.0, 30.0]),
    )
    for module in (scanning, scan_operator):
        monkeypatch.setattr(module, "read_observation", lambda _: observation)
        monkeypatch.setattr(module, "read_smooth_model", lambda _: model)
    settings = settings_of()
    paths = SimpleNamespace(
        settings=settings,
        observation=stand_in(tmp_path / "observation.h5", "observation", 1),
        smooth_model=stand_in(tmp_path / "smooth_model.h5", "smooth_model", 1),
        design=tmp_path / "design.h5",
        shards=[tmp_path / f"shard-{start}.h5" for start, _ in SPANS],
        model=model,
        image=item.image,
    )
    build(paths, settings)
    return paths


def stand_in(path, stage, number):
    write_artifact(path, Provenance(stage, {}), {"x": Dataset(np.array([number]), "", ("x",), "")}, {})
    return path


def build(paths, settings):
    build_design(paths, settings)
    for span, path in zip(SPANS, paths.shards, strict=True):
        run_stage("scan_operator", settings, path, span, design=paths.design, **lens(paths))


def build_design(paths, settings):
    run_stage("scan_design", settings, paths.design, **lens(paths))


def lens(paths):
    return {"observation": paths.observation, "smooth_model": paths.smooth_model}


def scanner(paths, settings=None):
    return Scanner(observed_job(paths, settings or paths.settings))


def observed_job(paths, settings, output=Path("never.h5")):
    inputs = {**lens(paths), "design": paths.design, "shards": paths.shards}
    return make_job("observed_scan", settings, output, inputs)


def test_scan_of_the_observation(campaign, tmp_path):
    output = tmp_path / "observed_scan.h5"
    run_job(observed_job(campaign, campaign.settings, output))
    with open_artifact(output, "observed_scan") as artifact:
        maps = {name: artifact.array(f"F814W/{name}") for name in ("delta_r", "r_smooth", "r_pert", "r_sens")}
        valid, chi2 = artifact.array("raster/valid"), artifact.array("F814W/chi2")
    assert all(array.shape == (4, 4) and np.isfinite(array).all() for array in maps.values())
    assert 0 < valid.sum() < 16
    np.testing.assert_array_equal(maps["delta_r"][~valid], 0.0)
    assert np.all(maps["r_sens"][valid] > 0.0)
    assert np.all(maps["r_smooth"][valid] < chi2)
    np.testing.assert_allclose(maps["r_pert"] - maps["r_smooth"], maps["delta_r"], atol=0.05 * chi2)


def test_statistics_and_sensitivity_of_the_observation(campaign, tmp_path):
    """Score, Fisher information and masses are written when asked for; theta_e needs no new operator."""
    asked = {"theta_e_arcsec": [0.001, 0.01, 0.1], "delta_r": 5.0}
    amplitude = settings_of(statistics=["delta_r", "amplitude"])
    build(campaign, amplitude)
    settings = settings_of(statistics=["delta_r", "amplitude"], sensitivity=asked).model_copy(
        update={
            "cosmology": CosmologyBlock(H0=69.31, Om0=0.315, Ob0=0.049, sigma8=0.829, ns=0.968, Tcmb0=2.7255),
            "redshifts": RedshiftBlock(lens=0.295, source=0.658),
        }
    )
    assert settings.of_operator() == amplitude
    output = tmp_path / "observed_scan.h5"
    run_job(observed_job(campaign, settings, output))
    with open_artifact(output, "observed_scan") as artifact:
        score, fisher, noise = (artifact.array(f"F814W/{name}") for name in ("score", "fisher", "fisher_noise"))
        theta_e, expected, mass = (
            artifact.array(f"sensitivity/{name}") for name in ("theta_e", "expected_delta_r", "min_mass")
        )
        valid = artifact.array("raster/valid")
        response = read_response(artifact)
    assert score.shape == fisher.shape == noise.shape == mass.shape == (4, 4)
    np.testing.assert_allclose(response.significance[valid], score[valid] / np.sqrt(fisher[valid]))
    assert np.all(fisher[valid] > noise[valid] * 0.5)
    np.testing.assert_array_equal(theta_e, asked["theta_e_arcsec"])
    assert expected.shape == (3, 4, 4)
    assert np.all(expected[:, ~valid] == 0.0)
    np.testing.assert_array_equal(np.isfinite(mass), np.any(expected <= -5.0, axis=0))
    assert np.isfinite(mass).any()
    middle = np.isfinite(mass) & (expected[1] <= -5.0) & (expected[0] > -5.0)
    assert np.all((mass[middle] <= 10.0**8.351) & (mass[middle] > 10.0**7.34))
    with pytest.raises(ArtifactError, match=r"scan\.statistics"):
        scanner(campaign)


def test_statistics_are_checked():
    with pytest.raises(ValueError, match="statistics must be"):
        settings_of(statistics=["amplitude"])
    with pytest.raises(ValueError, match="statistics: "):
        settings_of(sensitivity={"theta_e_arcsec": [0.01], "delta_r": 10.0})
    with pytest.raises(ValueError, match="rise"):
        settings_of(
            statistics=["delta_r", "amplitude"], sensitivity={"theta_e_arcsec": [0.02, 0.01], "delta_r": 1.0}
        )


def test_residual_samples_need_no_new_operator(campaign):
    """The list of samples is no setting of the operator: its shards stay good."""
    settings = settings_of(residual_samples=[3, 5])
    assert settings.of_operator() == campaign.settings
    images = np.stack([campaign.image] * 3)
    result = scanner(campaign, settings).scan("F814W", images, np.array([0, 2]))
    assert result.delta_r.shape == (3, 4, 4)
    assert {name: maps.shape for name, maps in result.residuals.items()} == dict.fromkeys(
        ("r_smooth", "r_pert", "r_sens"), (2, 4, 4)
    )
    assert scanner(campaign).scan("F814W", images, np.array([], dtype=np.int64)).residuals == {}


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"nested": None}, r"scan\.nested"),
        ({"perturber": {"theta_e_arcsec": 0.02, "r_trunc_arcsec": 0.1}}, r"scan\.perturber"),
        ({"marginalise_lens": True}, r"scan\.marginalise_lens = False, expected True"),
    ],
)
def test_other_settings_are_refused(campaign, changes, named):
    with pytest.raises(ArtifactError, match=rf"design\.h5.*other settings.*{named}.*delete"):
        scanner(campaign, settings_of(**changes))
    build_design(campaign, settings_of(**changes))
    with pytest.raises(ArtifactError, match=rf"shard-0\.h5.*other settings.*{named}.*delete"):
        scanner(campaign, settings_of(**changes))


@pytest.mark.parametrize("name", ["observation", "smooth_model"])
def test_another_input_is_refused(campaign, name):
    stand_in(getattr(campaign, name), name, 2)
    with pytest.raises(ArtifactError, match=rf"design\.h5.*another {name}"):
        scanner(campaign)
    build_design(campaign, campaign.settings)
    with pytest.raises(ArtifactError, match=rf"shard-0\.h5.*another {name}"):
        scanner(campaign)


def test_shard_of_another_design_is_refused(campaign):
    campaign.model.fixed["F814W"] = campaign.model.fixed["F814W"] * np.array([1.0, 2.0])
    build_design(campaign, campaign.settings)
    with pytest.raises(ArtifactError, match=r"shard-0\.h5.*another design"):
        scanner(campaign)


def test_truncated_missing_or_incomplete_shards_are_refused(campaign):
    whole = campaign.shards[1].read_bytes()
    campaign.shards[1].write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ArtifactError, match=r"shard-8\.h5"):
        scanner(campaign)
    campaign.shards.pop()
    with pytest.raises(ArtifactError, match="do not add up to the 16"):
        scanner(campaign)


def test_positions_beyond_the_raster_are_refused(campaign, tmp_path):
    with pytest.raises(ValueError, match=r"8 to 24.*raster has 16"):
        run_stage(
            "scan_operator",
            campaign.settings,
            tmp_path / "x.h5",
            (8, 24),
            design=campaign.design,
            **lens(campaign),
        )


def test_macro_columns_join_with_their_prior(campaign):
    settings = settings_of(marginalise_lens=True)
    build(campaign, settings)
    with open_artifact(campaign.design, "scan_design") as design:
        prior, norms = design.array("F814W/prior"), design.array("F814W/column_norms")
    np.testing.assert_array_equal(prior[:-2], 1e-8)
    np.testing.assert_allclose(prior[-2:], 1e-8 + (campaign.model.macro_sigma * norms[-2:]) ** -2.0)
    free = scanner(campaign, settings).scan("F814W", campaign.image[None], np.array([0]))
    assert free.delta_r.shape == (1, 4, 4)
    campaign.model.macro["F814W"] = np.empty((960, 0))
    with pytest.raises(ValueError, match=r"scan\.marginalise_lens"):
        build(campaign, settings)


def test_window_around_the_unmasked_pixels():
    grid = PixelGrid.centred((40, 60), 0.05)
    mask = np.zeros(grid.shape, dtype=bool)
    mask[5:15, 20:50] = True
    raster = Raster.around(mask, grid, 0.1)
    assert raster.shape == (5, 15)
    x, y = grid.coordinates()
    np.testing.assert_allclose(raster.center, (x[mask].mean(), y[mask].mean()))
    assert Raster.around(np.ones(grid.shape, dtype=bool), grid, 0.05).shape == (40, 60)
    turned = PixelGrid(40, 60, 0.05, 0.0, 0.0, ((0.0, -1.0), (1.0, 0.0)))
    assert Raster.around(mask, turned, 0.1).shape == (15, 5)
    with pytest.raises(ValueError, match="no pixel is unmasked"):
        Raster.around(np.zeros(grid.shape, dtype=bool), grid, 0.1)


def test_a_window_of_null_has_no_center():
    with pytest.raises(ValueError, match="center"):
        settings_of(window_arcsec=None, center=[0.1, 0.0])
