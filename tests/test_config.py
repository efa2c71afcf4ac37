from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from warmlens.config import Config
from warmlens.config_file import ConfigError, expand_path, load_config, parse_config

ROOT = Path(__file__).parents[1]
OVERLAYS = sorted((ROOT / "workflow/configs").glob("*.yaml"))


@pytest.fixture(scope="module")
def paper() -> dict[str, Any]:
    raw = yaml.safe_load((ROOT / "config.yaml").read_text())
    return json.loads(json.dumps(raw))  # without YAML's shared blocks: a change is a change of one key


def test_config_yaml_is_the_paper(paper: dict[str, Any]) -> None:
    config = parse_config(paper)
    assert config.campaign.n_samples == 2483
    assert config.dark_matter.m_th_kev == (1.0, 5.0)
    assert config.dark_matter.log10_m_halo_msun == (13.0, 13.5)
    assert (config.smooth_model.source.n_max, config.smooth_model.source.beta_arcsec) == (50, 0.18)
    assert (config.scan.perturber.theta_e_arcsec, config.scan.perturber.r_trunc_arcsec) == (0.01, 0.1)
    assert config.scan.step_arcsec == 0.05
    assert (config.summaries.threshold, config.summaries.max_separation_arcsec) == (-4.0, 2.5)
    assert config.abc.fraction == 0.05
    assert config.halos.preset == "paper"
    assert len(config.smooth_model.lens.kwargs_lens[3]["coeffs"]) == 21


@pytest.mark.parametrize("overlay", OVERLAYS, ids=lambda path: path.stem)
def test_overlays_are_valid(overlay: Path) -> None:
    assert isinstance(load_config([ROOT / "config.yaml", overlay]), Config)


def _changed(raw: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    result = copy.deepcopy(raw)
    *path, last = key.split(".")
    block = result
    for part in path:
        block = block[part]
    block[last] = value
    return result


@pytest.mark.parametrize(
    ("key", "value", "reported", "reason"),
    [
        ("redshifts.lens", -0.3, "redshifts.lens", "greater than 0"),
        ("redshifts.source", 0.2, "redshifts", "must lie behind lens"),
        ("dark_matter.m_th_kev", [5.0, 1.0], "dark_matter.m_th_kev", "must be below the upper end"),
        ("dark_matter.m_th_kev", [0.0, 5.0], "dark_matter", "above 0"),
        ("dark_matter.log10_m_halo_msun", [1e13, 3e13], "dark_matter", r"\[10, 16\]"),
        ("smooth_model.source.n_max", -1, "smooth_model.source.n_max", "greater than or equal to 0"),
        ("scan.step_arcsec", 0.0, "scan.step_arcsec", "greater than 0"),
        ("scan.step_arcsec", float("nan"), "scan.step_arcsec", "finite"),
        ("scan.window_arcsec", [0.01, 4.0], "scan", "smaller than step_arcsec"),
        ("campaign.n_samples", "many", "campaign.n_samples", "valid integer"),
        ("campaign.chunks", 3, "campaign.chunks", "unknown key"),
        ("halos.tau_dyn", "jvdb16", "halos", "preset: custom"),
        ("halos.preset", "best", "halos.preset", "'paper', 'calibrated' or 'custom'"),
        ("halos.branching", "pch09", "halos.branching", "one of pch08, benson17, pch_plus or four numbers"),
        ("halos.branching", [0.57, 0.38, -0.01], "halos.branching", "four numbers"),
        ("halos.transfer_function", "viel", "halos.transfer_function", "'viel05', 'bode01' or 'vogel23'"),
        ("cosmology.Ob0", 0.4, "cosmology", "must be below Om0"),
        ("observation.bands", ["F814W", "F160W"], "observation", "F160W"),
        ("observation.kind", "fits", "observation", "needs the block 'fits'"),
        ("observation.simulated.psf_pixels", 80, "observation.simulated", "must be odd"),
        ("smooth_model.lens.kwargs_lens", [], "smooth_model.lens", "must match"),
        ("summaries.threshold", 4.0, "summaries.threshold", "less than 0"),
        ("summaries.cumulative_min", -3.0, "summaries", "must be below threshold"),
        ("abc.fraction", 1.5, "abc.fraction", "less than or equal to 1"),
    ],
)
def test_impossible_values(paper: dict[str, Any], key: str, value: Any, reported: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason) as error:
        parse_config(_changed(paper, key, value))
    assert len(error.value.problems) == 1
    assert error.value.problems[0].startswith(f"{reported}: ")


def test_branching_by_name_or_numbers(paper: dict[str, Any]) -> None:
    for value in ("benson17", [0.6, 0.3, 0.0, 0.1]):
        stored = parse_config(_changed(paper, "halos.branching", value)).halos.branching
        assert stored == (tuple(value) if isinstance(value, list) else value)


def test_every_problem_has_its_line(paper: dict[str, Any]) -> None:
    broken = _changed(_changed(paper, "redshifts.lens", -1.0), "scan.step_arcsec", 0.0)
    del broken["abc"]["fraction"]
    with pytest.raises(ConfigError) as error:
        parse_config(broken)
    assert len(error.value.problems) == 3
    assert any(line.startswith("abc.fraction: missing") for line in error.value.problems)


def test_layers_are_merged_and_lists_replaced(tmp_path: Path) -> None:
    overlay = tmp_path / "overlay.yaml"
    overlay.write_text("scan: {step_arcsec: 0.1}\nobservation: {bands: [F555W]}\n")
    config = load_config([ROOT / "config.yaml", overlay])
    assert config.scan.step_arcsec == 0.1
    assert config.scan.window_arcsec == (5.0, 5.0)
    assert config.observation.bands == ["F555W"]


@pytest.mark.parametrize(("text", "reason"), [("a: [1", "not valid YAML"), ("- 1", "expected a mapping")])
def test_unreadable_files(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "broken.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=reason):
        load_config([path])
    with pytest.raises(ConfigError, match="no such file"):
        load_config([tmp_path / "absent.yaml"])


def test_paths_with_environment_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WARMLENS_TEST_FOLDER", "/data")
    assert expand_path("$WARMLENS_TEST_FOLDER/sci.fits") == Path("/data/sci.fits")
    monkeypatch.delenv("WARMLENS_TEST_FOLDER")
    with pytest.raises(ConfigError, match="WARMLENS_TEST_FOLDER is not set"):
        expand_path("${WARMLENS_TEST_FOLDER}/sci.fits")
