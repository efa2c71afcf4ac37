"""Stages `deflections` and `mocks` on a small observation, one after another as the workflow runs them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import open_artifact
from warmlens.config.file import load_config, parse_config
from warmlens.config.model import Config
from warmlens.fitting.smooth_model import scan_band
from warmlens.imaging.psf import point_source
from warmlens.lensing.images import DeflectionField, moved_images
from warmlens.lensing.substructure import filtered_deflection
from warmlens.physics import geometry, halo_generator
from warmlens.products.observation import read_observation
from warmlens.products.samples import FAILED_HERE, OK
from warmlens.products.smooth_model import read_smooth_model
from warmlens.sampling import stream
from warmlens.stage_table import stage_settings
from warmlens.stages import deflections
from warmlens.stages.mocks import noise_free_image

from ..reliability import Outcome, fault
from ..shared import run_stage

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def config() -> Config:
    config = load_config([ROOT / "config.yaml", ROOT / "workflow/configs/ci.yaml"])
    raw = config.model_dump()
    raw["smooth_model"]["source"]["n_max"] = 6
    raw["smooth_model"]["allow_poor_fit"] = True
    return parse_config(raw)


def _with(config: Config, block: str, **values: Any) -> Config:
    raw = config.model_dump()
    raw[block].update(values)
    return parse_config(raw)


@pytest.fixture(scope="module")
def folder(config: Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Artifacts of three samples, quasars where they are observed."""
    path = tmp_path_factory.mktemp("mocks")
    observed = path / "observation.h5"
    run_stage("observation", stage_settings(config, "observation"), observed)
    run_stage(
        "smooth_model", stage_settings(config, "smooth_model"), path / "smooth_model.h5", observation=observed
    )
    run_stage("halos", stage_settings(config, "halos"), path / "halos.h5", (0, 3))
    _deflect(config, path, "deflections.h5")
    _mock(config, path, "deflections.h5", "mocks.h5")
    return path


def _deflect(config: Config, folder: Path, output: str) -> np.ndarray:
    inputs = {"halos": folder / "halos.h5", "observation": folder / "observation.h5"}
    run_stage("deflections", stage_settings(config, "deflections"), folder / output, **inputs)
    with open_artifact(folder / output, "deflections") as artifact:
        return artifact.array("delta_alpha")


def _mock(config: Config, folder: Path, delta: str, output: str) -> None:
    run_stage(
        "mocks", stage_settings(config, "mocks"), folder / output, deflections=folder / delta, **_lens(folder)
    )


def _lens(folder: Path) -> dict[str, Path]:
    return {"observation": folder / "observation.h5", "smooth_model": folder / "smooth_model.h5"}


def test_deflections_are_those_of_the_subhalos(config: Config, folder: Path) -> None:
    grid = read_observation(folder / "observation.h5").grid
    _, lens = geometry(config.cosmology, config.redshifts)
    with open_artifact(folder / "halos.h5", "halos") as artifact:
        subhalos = deflections.read_subhalos(artifact, 1)
    with open_artifact(folder / "deflections.h5", "deflections") as artifact:
        stored = artifact.array("delta_alpha")[1]
        assert artifact.metadata["filter_sigma_arcsec"] == pytest.approx(0.4)
        assert artifact.array("rms")[1] == pytest.approx(np.sqrt(np.mean(np.sum(stored**2, axis=0))), rel=1e-5)
    expected = filtered_deflection(subhalos, grid, lens, 0.4)
    np.testing.assert_allclose(stored, expected, atol=1e-6 * np.abs(expected).max())
    assert np.abs(expected).max() > 1e-4


@pytest.mark.parametrize("kind", ["starlet", "median_wavelet"])
def test_other_filters(config: Config, folder: Path, kind: str) -> None:
    other = _deflect(_with(config, "deflections", filter=kind), folder, f"{kind}.h5")
    with open_artifact(folder / "deflections.h5", "deflections") as artifact:
        gaussian = artifact.array("delta_alpha")
    with open_artifact(folder / f"{kind}.h5", "deflections") as artifact:
        assert 0.3 < artifact.metadata["filter_sigma_arcsec"] < 0.5
        assert artifact.metadata["filter_sigma_arcsec"] != pytest.approx(0.4)
    assert 0.8 < np.corrcoef(other.ravel(), gaussian.ravel())[0, 1] < 0.9999


def test_smooth_host_is_the_halo_without_its_subhalos(config: Config, folder: Path) -> None:
    with_host = _deflect(_with(config, "deflections", smooth_host=True), folder, "host.h5")
    grid = read_observation(folder / "observation.h5").grid
    _, lens = geometry(config.cosmology, config.redshifts)
    generator = halo_generator(config.cosmology, config.redshifts, config.halos)
    with open_artifact(folder / "halos.h5", "halos") as artifact:
        f_sub = artifact.array("halo/f_sub")
        log10_m_halo = artifact.array("samples/log10_m_halo_msun")
        subhalos = [deflections.read_subhalos(artifact, row) for row in range(3)]
    assert (f_sub > 1e-3).all()
    for row in range(3):
        host = deflections.smooth_host(generator, log10_m_halo[row], f_sub[row])
        bare = deflections.smooth_host(generator, log10_m_halo[row], 0.0)
        assert host.rho_s == pytest.approx((1.0 - f_sub[row]) * bare.rho_s)
        expected = filtered_deflection(subhalos[row], grid, lens, 0.4, host=host)
        np.testing.assert_allclose(with_host[row], expected, atol=1e-6 * np.abs(expected).max())
    with open_artifact(folder / "deflections.h5", "deflections") as artifact:
        assert np.abs(with_host - artifact.array("delta_alpha")).max() > 1e-3


@pytest.mark.parametrize("supersampling", [1, 2])
def test_a_mock_without_substructure_is_the_smooth_model(
    config: Config, folder: Path, tmp_path: Path, supersampling: int
) -> None:
    source = config.smooth_model.source.model_dump() | {"supersampling": supersampling}
    changed = _with(config, "smooth_model", source=source)
    settings = stage_settings(changed, "smooth_model")
    run_stage("smooth_model", settings, tmp_path / "model.h5", observation=folder / "observation.h5")
    observed, model = read_observation(folder / "observation.h5"), read_smooth_model(tmp_path / "model.h5")
    field = DeflectionField(model.deflection, observed.grid)
    quasars = np.array(config.smooth_model.quasar_images)
    still = moved_images(field, field, quasars)
    for band in observed.bands:
        band_model = model.fits[band.name].model
        scanned = scan_band(observed, model, band.name)
        none = np.zeros((2, *observed.grid.shape))
        for positions in (None, still):
            image = noise_free_image(model, observed.grid, *scanned, none, positions)
            assert np.abs(image - band_model).max() < 1e-10 * np.abs(band_model).max()
        bent = noise_free_image(model, observed.grid, *scanned, none + 1e-3)
        assert np.abs(bent - band_model).max() > 1e-5 * np.abs(band_model).max()


def test_noise_is_drawn_per_sample_and_band(config: Config, folder: Path) -> None:
    observed, model = read_observation(folder / "observation.h5"), read_smooth_model(folder / "smooth_model.h5")
    with open_artifact(folder / "deflections.h5", "deflections") as artifact:
        delta = artifact.array("delta_alpha").astype(float)
    pulls = []
    with open_artifact(folder / "mocks.h5", "mocks") as artifact:
        assert "quasar_positions" not in artifact.file
        for band in observed.bands:
            noisy = artifact.array(f"{band.name}/image")
            scanned, convolution = scan_band(observed, model, band.name)
            for row in range(3):
                clean = noise_free_image(model, observed.grid, scanned, convolution, delta[row])
                rng = stream(config.campaign.seed, "mocks", row, band.name)
                expected = band.noise.draw(clean, scanned.sigma, rng)
                np.testing.assert_allclose(noisy[row], expected, rtol=1e-6, atol=1e-6)
                pulls.append(((noisy[row] - clean) / band.noise.sigma(clean)).ravel())
    n = pulls[0].size
    for pull in pulls:
        assert abs(pull.mean()) < 5.0 / np.sqrt(n)
        assert pull.std() == pytest.approx(1.0, abs=5.0 / np.sqrt(2.0 * n))
    correlation = np.corrcoef(pulls) - np.eye(len(pulls))
    assert np.abs(correlation).max() < 5.0 / np.sqrt(n)  # no two share their noise


def test_mocks_of_the_null_test_are_the_smooth_model_with_noise_of_their_own(config: Config, folder: Path) -> None:
    settings = stage_settings(_with(config, "null_test", n_mocks=5), "null_mocks")
    run_stage("null_mocks", settings, folder / "null.h5", **_lens(folder))
    observed, model = read_observation(folder / "observation.h5"), read_smooth_model(folder / "smooth_model.h5")
    with open_artifact(folder / "null.h5", "null_mocks") as artifact:
        assert artifact.span == (0, 5)
        assert artifact.array("samples/status").tolist() == [OK] * 5
        assert np.isnan(artifact.array("samples/m_th_kev")).all()
        images = {band.name: artifact.array(f"{band.name}/image") for band in observed.bands}
    for band in observed.bands:
        clean = model.fits[band.name].model
        scanned, _ = scan_band(observed, model, band.name)
        for i in range(5):
            rng = stream(config.campaign.seed, "null", i, band.name)
            expected = band.noise.draw(clean, scanned.sigma, rng)
            np.testing.assert_allclose(images[band.name][i], expected, rtol=1e-6, atol=1e-6)
        pull = (images[band.name] - clean) / band.noise.sigma(clean)
        assert np.sqrt(np.mean(pull.mean(axis=0) ** 2)) == pytest.approx(np.sqrt(1 / 5), rel=0.05)
    with open_artifact(folder / "mocks.h5", "mocks") as artifact:
        assert not np.array_equal(artifact.array("F814W/image")[0], images["F814W"][0])


def test_solved_quasars_obey_the_perturbed_lens_equation(config: Config, folder: Path) -> None:
    solved = _with(config, "mocks", quasar_positions="solved")
    _mock(solved, folder, "deflections.h5", "solved.h5")
    observed, model = read_observation(folder / "observation.h5"), read_smooth_model(folder / "smooth_model.h5")
    quasars = np.array(config.smooth_model.quasar_images)
    smooth = DeflectionField(model.deflection, observed.grid)
    scatter = np.ptp(smooth.lens(quasars)[0], axis=0)
    with open_artifact(folder / "deflections.h5", "deflections") as artifact:
        delta = artifact.array("delta_alpha").astype(float)
    with open_artifact(folder / "solved.h5", "mocks") as artifact:
        positions = artifact.array("quasar_positions")
        image = artifact.array("F814W/image")[0]
    with open_artifact(folder / "mocks.h5", "mocks") as artifact:
        before = artifact.array("F814W/image")[0]
    moves = positions - quasars
    assert 1e-4 < np.abs(moves).max() < 0.5
    for row in range(3):
        traced = DeflectionField(model.deflection + delta[row], observed.grid).lens(positions[row])[0]
        stays = DeflectionField(model.deflection + delta[row], observed.grid).lens(quasars)[0]
        spread = np.ptp(traced, axis=0) - scatter  # what the smooth lens misses is kept
        assert np.abs(spread).max() < 0.1 * np.abs(stays - smooth.lens(quasars)[0]).max() + 1e-4
    band = observed.bands[0]
    fit = model.fits[band.name]
    expected = sum(
        flux * (point_source(band.psf, observed.grid, *new) - point_source(band.psf, observed.grid, *old))
        for flux, new, old in zip(fit.fixed_coefficients[:4], positions[0], quasars, strict=True)
    )
    # outside of the quasars the noise is the same number by number; near them its counts are drawn anew
    noise = 6.0 * np.sqrt(2.0) * band.noise.sigma(fit.model + np.abs(expected))
    assert (np.abs(image - before - expected) < noise).all()
    assert (np.abs(expected) > noise).any()


def test_a_quasar_without_a_solution_fails_its_sample_alone(config: Config, folder: Path) -> None:
    with open_artifact(folder / "deflections.h5", "deflections") as artifact:
        n = artifact.array("delta_alpha").shape[0]
    bad = folder / "torn.h5"
    settings = stage_settings(config, "deflections")
    original = deflections.filtered_deflection
    calls = iter(range(n))

    def torn(*arguments: Any, **keywords: Any) -> np.ndarray:
        delta = original(*arguments, **keywords)
        if next(calls) == 1:
            delta[0] += 3.0  # the source leaves the caustic
        return delta

    deflections.filtered_deflection = torn
    try:
        inputs = {"halos": folder / "halos.h5", "observation": folder / "observation.h5"}
        run_stage("deflections", settings, bad, **inputs)
    finally:
        deflections.filtered_deflection = original
    _mock(_with(config, "mocks", quasar_positions="solved"), folder, "torn.h5", "failed.h5")
    with open_artifact(folder / "failed.h5", "mocks") as artifact:
        assert artifact.array("samples/status").tolist() == [OK, FAILED_HERE, OK]
        assert "point-source image" in artifact.strings("samples/message")[1]
        assert np.isnan(artifact.array("F814W/image")[1]).all()
        assert np.isfinite(artifact.array("F814W/image")[2]).all()


def test_solved_positions_need_quasars(config: Config, folder: Path) -> None:
    raw = config.model_dump()
    raw["mocks"]["quasar_positions"] = "solved"
    raw["smooth_model"] |= {"quasar_images": []}
    raw["smooth_model"]["source"]["center"] = (-0.503, -0.058)
    without = parse_config(raw)
    lensed = folder / "no-quasars.h5"
    observed = folder / "observation.h5"
    run_stage("smooth_model", stage_settings(without, "smooth_model"), lensed, observation=observed)
    with pytest.raises(ArtifactError, match="needs quasar images"):
        inputs = {"deflections": folder / "deflections.h5", "observation": observed, "smooth_model": lensed}
        run_stage("mocks", stage_settings(without, "mocks"), folder / "never.h5", **inputs)


@fault("Samples", "hosts below the resolution", "a prior of hosts below twice the Jeans mass", quick=True)
def test_hosts_too_light_for_subhalos_are_samples_like_others(
    config: Config, folder: Path, tmp_path: Path, outcome: Outcome
) -> None:
    """No subhalos: the deflection is exactly 0, the mock that of the smooth lens, and nothing has failed."""
    raw = config.model_dump()
    raw["dark_matter"] = {"m_th_kev": (0.05, 0.06), "log10_m_halo_msun": (10.0, 10.3)}
    light = parse_config(raw)
    run_stage("halos", stage_settings(light, "halos"), tmp_path / "halos.h5", (0, 2))
    with open_artifact(tmp_path / "halos.h5", "halos") as artifact:
        assert artifact.array("samples/status").tolist() == [OK, OK]
        assert artifact.array("subhalos/offsets").tolist() == [0, 0, 0]
        assert artifact.array("halo/f_sub").tolist() == [0.0, 0.0]
    (tmp_path / "observation.h5").symlink_to(folder / "observation.h5")
    (tmp_path / "smooth_model.h5").symlink_to(folder / "smooth_model.h5")
    for kind in ("gaussian", "starlet", "median_wavelet"):
        assert not _deflect(_with(light, "deflections", filter=kind), tmp_path, f"{kind}.h5").any()
    hosts = _deflect(_with(light, "deflections", smooth_host=True), tmp_path, "hosts.h5")
    assert np.isfinite(hosts).all()
    assert np.abs(hosts).max() > 1e-6
    for quasars in ("observed", "solved"):
        _mock(_with(light, "mocks", quasar_positions=quasars), tmp_path, "gaussian.h5", f"{quasars}.h5")
        with open_artifact(tmp_path / f"{quasars}.h5", "mocks") as artifact:
            assert artifact.array("samples/status").tolist() == [OK, OK]
            assert np.isfinite(artifact.array(f"{config.observation.bands[0]}/image")).all()
    outcome.goes_on("they are smooth halos, without subhalos", "nothing")
