from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.config.file import ConfigError, load_config, parse_config
from warmlens.config.model import Config
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.psf import fwhm
from warmlens.lensing.substructure import filtered_deflection, required_half_width
from warmlens.physics import geometry, halo_generator
from warmlens.products.images import planned_mask
from warmlens.products.observation import read_observation
from warmlens.products.smooth_model import read_smooth_model
from warmlens.sampling import stream
from warmlens.stage_table import stage_settings

from ..shared import run_stage

ROOT = Path(__file__).parents[2]
SIMULATED = [[], ["demo"], ["ci"]]


@pytest.fixture(scope="module")
def ci() -> Config:
    return load_config([ROOT / "config.yaml", ROOT / "workflow/configs/ci.yaml"])


@pytest.fixture(scope="module")
def simulated(ci: Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("observation") / "observation.h5"
    run_stage("observation", stage_settings(ci, "observation"), path)
    return path


def test_substructure_is_drawn_by_the_halo_stage(ci: Config, simulated: Path) -> None:
    truth = ci.observation.simulated.truth
    realization = halo_generator(ci.cosmology, ci.redshifts, ci.halos).draw(
        truth.m_th_kev,
        10**truth.log10_m_halo_msun,
        ci.halos.field_half_width_arcsec,
        stream(truth.seed, "halos", 0),
    )
    _, lens = geometry(ci.cosmology, ci.redshifts)
    observed = read_observation(simulated)
    with open_artifact(simulated) as artifact:
        assert artifact.metadata["truth"] == truth.model_dump()
        stored = artifact.array("truth/delta_alpha")
    expected = filtered_deflection(realization.subhalos, observed.grid, lens, ci.deflections.filter_arcsec)
    assert np.array_equal(stored, expected)
    assert np.abs(stored).max() > 1e-4


def test_bands(simulated: Path) -> None:
    observed = read_observation(simulated)
    red, blue = observed.bands
    assert (red.name, blue.name) == ("F814W", "F555W")
    assert fwhm(blue.psf, 0.05) < fwhm(red.psf, 0.05)
    corner = slice(0, 15), slice(-15, None)  # neighbours there differ by noise alone
    pull = np.diff(red.image[corner], axis=1) / (np.sqrt(2.0) * red.sigma[corner][:, 1:])
    assert pull.std() == pytest.approx(1.0, abs=4.0 / np.sqrt(2 * pull.size))
    assert not np.array_equal(red.image, blue.image)


def test_same_input_same_digest(ci: Config, simulated: Path, tmp_path: Path) -> None:
    run_stage("observation", stage_settings(ci, "observation"), tmp_path / "again.h5")
    with open_artifact(simulated) as first, open_artifact(tmp_path / "again.h5") as second:
        assert first.digest == second.digest


def test_smooth_model_reaches_the_noise(ci: Config, simulated: Path, tmp_path: Path) -> None:
    run_stage("smooth_model", stage_settings(ci, "smooth_model"), tmp_path / "smooth.h5", observation=simulated)
    model = read_smooth_model(tmp_path / "smooth.h5")
    for name, fit in model.fits.items():
        assert fit.chi2_red < 1.3, name
        fluxes = ci.observation.simulated.bands[name].quasar_fluxes
        np.testing.assert_allclose(fit.fixed_coefficients[:4], fluxes, rtol=0.02)


def test_nothing_but_a_source(ci: Config, tmp_path: Path) -> None:
    """No quasars, no lens light, no background: still an observation and a model."""
    raw = ci.model_dump()
    nothing = {"lens_light_model_list": [], "kwargs_lens_light": []}
    raw["observation"]["simulated"].update(quasar_images=[], lens_light=nothing)
    for band in raw["observation"]["simulated"]["bands"].values():
        band.update(quasar_fluxes=[], lens_light_amplitudes=[], sky=0.0)
    raw["smooth_model"].update(quasar_images=[], lens_light=nothing, fit_background=False)
    raw["smooth_model"]["source"]["center"] = (-0.503, -0.058)
    config = parse_config(raw)
    run_stage("observation", stage_settings(config, "observation"), tmp_path / "o.h5")
    run_stage(
        "smooth_model", stage_settings(config, "smooth_model"), tmp_path / "s.h5", observation=tmp_path / "o.h5"
    )
    model = read_smooth_model(tmp_path / "s.h5")
    assert model.names == ()
    assert all(fit.chi2_red < 1.3 for fit in model.fits.values())


def test_supersampling_converges(ci: Config, tmp_path: Path) -> None:
    """Source, light and perturbation on 2 x 2 sub-pixels: the same quasars, chi2 near 1."""
    raw = ci.model_dump()
    raw["observation"]["simulated"]["supersampling"] = 2
    raw["smooth_model"]["source"]["supersampling"] = 2
    config = parse_config(raw)
    run_stage("observation", stage_settings(config, "observation"), tmp_path / "o.h5")
    run_stage(
        "smooth_model", stage_settings(config, "smooth_model"), tmp_path / "s.h5", observation=tmp_path / "o.h5"
    )
    assert all(fit.chi2_red < 1.3 for fit in read_smooth_model(tmp_path / "s.h5").fits.values())


@pytest.mark.parametrize("overlays", SIMULATED, ids=lambda names: "-".join(names) or "paper")
def test_fields_of_subhalos_reach_beyond_the_images(overlays: list[str]) -> None:
    config = load_config([ROOT / "config.yaml", *(ROOT / f"workflow/configs/{name}.yaml" for name in overlays)])
    block = config.observation.simulated
    grid = PixelGrid.centred(block.shape, block.pixel_scale_arcsec)
    assert config.halos.field_half_width_arcsec >= required_half_width(grid, config.deflections.filter_arcsec)


def test_a_field_that_is_too_small(ci: Config, tmp_path: Path) -> None:
    raw = ci.model_dump()
    raw["halos"]["field_half_width_arcsec"] = 3.0
    with pytest.raises(ValueError, match=r"halos\.field_half_width_arcsec = 3 is too small.* reach 3\.70"):
        run_stage("observation", stage_settings(parse_config(raw), "observation"), tmp_path / "o.h5")


def _taken(config: Config, source: Path, bands: list[str]) -> Config:
    raw = config.model_dump()
    raw["observation"].update(kind="artifact", artifact=str(source), bands=bands)
    return parse_config(raw)


def test_the_observation_of_another_campaign(ci: Config, simulated: Path, tmp_path: Path) -> None:
    config = _taken(ci, simulated, ["F814W", "F555W"])
    run_stage("observation", stage_settings(config, "observation"), tmp_path / "same.h5")
    with open_artifact(simulated) as original, open_artifact(tmp_path / "same.h5", "observation") as copy:
        assert copy.digest == original.digest  # truth and all
        assert copy.settings != original.settings
        assert copy.inputs["artifact"]["digest"] == original.digest
    run_stage("observation", stage_settings(_taken(ci, simulated, ["F555W"]), "observation"), tmp_path / "one.h5")
    (band,) = read_observation(tmp_path / "one.h5").bands
    expected = read_observation(simulated).bands[1]
    assert (band.name, band.noise) == ("F555W", expected.noise)
    assert np.array_equal(band.image, expected.image)
    with open_artifact(tmp_path / "one.h5") as copy, open_artifact(simulated) as original:
        assert copy.digest != original.digest
        assert copy.metadata["bands"] == ["F555W"]
        assert np.array_equal(copy.array("truth/delta_alpha"), original.array("truth/delta_alpha"))
    grid, mask = planned_mask(config.observation)
    assert mask.shape == grid.shape == (100, 100)


def test_an_observation_that_cannot_be_taken(ci: Config, simulated: Path, tmp_path: Path) -> None:
    def run(source: Path, bands: list[str]) -> None:
        run_stage("observation", stage_settings(_taken(ci, source, bands), "observation"), tmp_path / "out.h5")

    with pytest.raises(ConfigError, match=r"has no bands \['F160W'\]; it has \['F814W', 'F555W'\]"):
        run(simulated, ["F814W", "F160W"])
    with pytest.raises(ConfigError, match=r"absent\.h5: no such file; run the campaign that makes it first"):
        run(tmp_path / "absent.h5", ["F814W"])
    damaged = tmp_path / "damaged.h5"
    damaged.write_bytes(simulated.read_bytes()[:5000])
    with pytest.raises(ArtifactError, match=r"damaged\.h5"):
        run(damaged, ["F814W"])
    other = tmp_path / "halos.h5"
    write_artifact(other, Provenance("halos", {}), {}, {})
    with pytest.raises(ArtifactError, match=r"halos\.h5: holds stage 'halos', expected 'observation'"):
        run(other, ["F814W"])
    assert not (tmp_path / "out.h5").exists()
