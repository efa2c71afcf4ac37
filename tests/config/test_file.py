from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from warmlens.config.file import ConfigError, expand_path, load_config, parse_config
from warmlens.config.model import Config

ROOT = Path(__file__).parents[2]
OVERLAYS = sorted(path for path in (ROOT / "workflow/configs").glob("*.yaml") if "systematics" not in path.stem)


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
        ("smooth_model.fit", None, "smooth_model", "mode: fit needs the block 'fit'"),
        ("smooth_model.mode", "search", "smooth_model.mode", "'given' or 'fit'"),
        ("smooth_model.fit.levels", [10, 30, 20], "smooth_model.fit.levels", r"must rise .*, got \[10, 30, 20\]"),
        ("smooth_model.fit.levels", [10, 10, 20], "smooth_model.fit.levels", "must rise"),
        ("smooth_model.fit.levels", [10, 50], "smooth_model", "must end below source.n_max = 50"),
        ("smooth_model.fit.lens_free", [{}, {}], "smooth_model", "3 entries, fit.lens_free has 2"),
        ("smooth_model.fit.lens_free", [{}, {}, {}, {}], "smooth_model", "3 entries, fit.lens_free has 4"),
        ("smooth_model.fit.lens_light_free", [{}], "smooth_model", "3 entries, fit.lens_light_free has 1"),
        (
            "smooth_model.fit.satellites",
            [[3, 2]],
            "smooth_model",
            r"\[3, 2\] names a component that does not exist",
        ),
        (
            "smooth_model.fit.satellites",
            [[2, 3]],
            "smooth_model",
            r"\[2, 3\] names a component that does not exist",
        ),
        (
            "smooth_model.fit.satellites",
            [[-1, 2]],
            "smooth_model.fit.satellites.0.0",
            "greater than or equal to 0",
        ),
        ("smooth_model.fit.potential_shapelets.number", 7, "smooth_model.fit.potential_shapelets.number", "21"),
        (
            "smooth_model.fit.potential_shapelets.sigma",
            0.0,
            "smooth_model.fit.potential_shapelets.sigma",
            "than 0",
        ),
        ("smooth_model.fit.tie_arcsec", 0.0, "smooth_model.fit.tie_arcsec", "greater than 0"),
        ("smooth_model.fit.tolerance", 1.0, "smooth_model.fit.tolerance", "less than 1"),
        ("smooth_model.fit.search.particles", 3, "smooth_model.fit.search.particles", "equal to 4"),
        ("smooth_model.quasar_images", [], "smooth_model", "center: quasars needs quasar_images"),
        ("smooth_model.chi2_red_range", [1.1, 0.9], "smooth_model.chi2_red_range", "must be below the upper end"),
        ("summaries.threshold", 4.0, "summaries.threshold", "less than 0"),
        ("summaries.cumulative_min", -3.0, "summaries", "must be below threshold"),
        ("summaries.count_thresholds", [-4.0, -10.0], "summaries.count_thresholds", "must rise"),
        ("summaries.count_thresholds", [], "summaries.count_thresholds", "at least 1 item"),
        ("null_test.n_mocks", -1, "null_test.n_mocks", "greater than or equal to 0"),
        ("abc.summaries", "best", "abc.summaries", "'paper', 'sharper' or 'learned'"),
        ("abc.summaries", "sharper", "config", r"set scan\.statistics: \[delta_r, amplitude\]"),
        ("deflections.filter", "wavelet", "deflections.filter", "'gaussian', 'starlet' or 'median_wavelet'"),
        ("deflections.smooth_host", "perhaps", "deflections.smooth_host", "valid boolean"),
        ("mocks.quasar_positions", "fixed", "mocks.quasar_positions", "'observed' or 'solved'"),
        ("abc.fraction", 1.5, "abc.fraction", "less than or equal to 1"),
    ],
)
def test_impossible_values(paper: dict[str, Any], key: str, value: Any, reported: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason) as error:
        parse_config(_changed(paper, key, value))
    assert len(error.value.problems) == 1
    assert error.value.problems[0].startswith(f"{reported}: ")


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ([2.0, 1.2, 0.1], "the lower limit 2 must be below the upper limit 1.2"),
        ([1.2, 1.2, 0.1], "must be below the upper limit"),
        ([1.2, 2.0, 0.0], "greater than 0"),
        ([1.2, float("inf"), None], "finite"),
    ],
)
def test_impossible_free_ranges(paper: dict[str, Any], value: list[float | None], reason: str) -> None:
    free = [{"theta_E": value}, {}, {}]
    with pytest.raises(ConfigError, match=reason) as error:
        parse_config(_changed(paper, "smooth_model.fit.lens_free", free))
    assert error.value.problems[0].startswith("smooth_model.fit.lens_free.0.theta_E")


def test_psf_fit_needs_quasars(paper: dict[str, Any]) -> None:
    psf = {"iterations": 1, "radius_arcsec": 0.5, "relative_sigma": 0.1, "wing_radii_arcsec": [0.5, 0.8],
           "unknown_fraction": 0.1}  # fmt: skip
    with_psf = _changed(paper, "smooth_model.fit.psf", psf)
    assert parse_config(with_psf).smooth_model.fit is not None
    bare = _changed(_changed(with_psf, "smooth_model.quasar_images", []), "smooth_model.source.center", [0.0, 0.0])
    with pytest.raises(ConfigError, match=r"fit\.psf improves the PSF on the quasar images"):
        parse_config(bare)


def test_given_lens_needs_no_fit_block(paper: dict[str, Any]) -> None:
    given = _changed(_changed(paper, "smooth_model.mode", "given"), "smooth_model.fit", None)
    with pytest.raises(
        ConfigError, match=r"scan\.marginalise_lens needs .*mode: given has not; .* set it to false"
    ):
        parse_config(given)
    assert parse_config(_changed(given, "scan.marginalise_lens", False)).smooth_model.fit is None


def test_a_fit_drops_the_potential_shapelets_of_the_start(paper: dict[str, Any]) -> None:
    """They are started from 0 by fit.potential_shapelets; the others keep their order, wherever it is."""
    block = parse_config(paper).smooth_model
    assert block.lens.lens_model_list == ["EPL", "SHEAR", "SIS", "SHAPELETS_CART"]
    assert block.fitted_lens.lens_model_list == ["EPL", "SHEAR", "SIS"]
    assert block.fitted_lens.kwargs_lens == block.lens.kwargs_lens[:3]
    lens = paper["smooth_model"]["lens"]
    turned = {key: [lens[key][i] for i in (3, 2, 0, 1)] for key in ("lens_model_list", "kwargs_lens")}
    fitted = parse_config(_changed(paper, "smooth_model.lens", turned)).smooth_model.fitted_lens
    assert fitted.lens_model_list == ["SIS", "EPL", "SHEAR"]
    assert fitted.kwargs_lens == [lens["kwargs_lens"][i] for i in (2, 0, 1)]


def test_branching_by_name_or_numbers(paper: dict[str, Any]) -> None:
    for value in ("benson17", [0.6, 0.3, 0.0, 0.1]):
        stored = parse_config(_changed(paper, "halos.branching", value)).halos.branching
        assert stored == (tuple(value) if isinstance(value, list) else value)


@pytest.mark.parametrize(
    ("key", "remedy"),
    [
        ("halos.min_mas_msun", "did you mean min_mass_msun?"),
        ("halo", "did you mean halos?"),
        ("observation.simulated.bands.F814W.wavelenght_nm", "did you mean wavelength_nm?"),
        ("smooth_model.fit.tie_arcsecs", "did you mean tie_arcsec?"),
        ("campaign.step_arcsec", "it belongs under scan"),
        ("scan.abc", "it belongs at the top level"),
        ("scan.zzz", "remove it or correct its spelling (config.yaml lists all keys)"),
    ],
)
def test_an_unknown_key_is_reported_with_the_nearest_one(paper: dict[str, Any], key: str, remedy: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_config(_changed(paper, key, 1))
    assert error.value.problems == [f"{key}: unknown key; {remedy}"]


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


def _grid(**changes: Any) -> dict[str, Any]:
    grid = {"m_th_kev": [1.0, 2.0, 5.0], "log10_m_halo_msun": [13.0, 13.5], "realizations": 4}
    return {"seed": 1, "n_samples": 24, "chunk_size": 6, "design": "grid", "grid": {**grid, **changes}}


def test_grid_design(paper: dict[str, Any]) -> None:
    campaign = parse_config(_changed(paper, "campaign", _grid())).campaign
    assert campaign.grid is not None
    assert campaign.grid.n_nodes == 6


@pytest.mark.parametrize(
    ("campaign", "reason"),
    [
        (
            _grid(realizations=5),
            r"n_samples = 24, but the grid has 6 nodes x 5 realizations = 30; set n_samples: 30",
        ),
        (_grid(m_th_kev=[2.0, 1.0, 5.0]), r"m_th_kev: must rise from value to value"),
        (_grid(m_th_kev=[1.0, float("nan"), 5.0]), "finite"),
        (_grid(log10_m_halo_msun=[13.0]), "at least 2 items"),
        (
            _grid(m_th_kev=[1.0, 2.0, 7.0]),
            r"campaign.grid.m_th_kev \[7.0\] lie outside dark_matter.m_th_kev = \[1, 5\]",
        ),
        (_grid(log10_m_halo_msun=[12.0, 13.5]), r"log10_m_halo_msun \[12.0\] lie outside"),
        ({**_grid(), "grid": None}, "design: grid needs the block 'grid'"),
        ({**_grid(), "design": "prior"}, "grid is given with design: prior"),
        ({**_grid(), "design": "random"}, "'prior' or 'grid'"),
    ],
)
def test_impossible_grids(paper: dict[str, Any], campaign: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason) as error:
        parse_config(_changed(paper, "campaign", campaign))
    assert len(error.value.problems) == 1


def test_observation_of_another_campaign_needs_its_path(paper: dict[str, Any]) -> None:
    taken = {**paper["observation"], "kind": "artifact", "artifact": "results/other/observation.h5"}
    assert parse_config(_changed(paper, "observation", taken)).observation.artifact == taken["artifact"]
    with pytest.raises(ConfigError, match="kind: artifact needs the key 'artifact'"):
        parse_config(_changed(paper, "observation.kind", "artifact"))
