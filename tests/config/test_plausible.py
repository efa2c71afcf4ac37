"""Numbers that nobody means: a question with the likely mistake, and how it is answered."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel

from warmlens.config.file import ConfigError, load_config, parse_block, parse_config, read_stored
from warmlens.config.model import Config
from warmlens.config.plausible import Usual, questions
from warmlens.stage_table import stage_digests

from ..reliability import Outcome, fault

ROOT = Path(__file__).parents[2]
OVERLAYS = sorted(path for path in (ROOT / "workflow/configs").glob("*.yaml") if "systematics" not in path.stem)


@pytest.fixture(scope="module")
def paper() -> dict[str, Any]:
    return json.loads(json.dumps(yaml.safe_load((ROOT / "config.yaml").read_text())))


def changed(raw: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    result = copy.deepcopy(raw)
    *path, last = key.split(".")
    block = result
    for part in path:
        block = block[part]
    block[last] = value
    return result


BAND = "observation.simulated.bands.F814W"
MISTAKES: list[tuple[str, Any, str]] = [
    ("cosmology.H0", 0.6931, "expected 50 to 100 km/s/Mpc; did you mean 69.31 (h)"),
    ("cosmology.H0", 6931, "expected 50 to 100 km/s/Mpc; to keep it"),
    ("cosmology.Ob0", 0.0224, "not Ob0 h^2"),
    ("cosmology.sigma8", 82.9, "did you mean 0.829 (percent)"),
    ("cosmology.Tcmb0", 2725.5, "did you mean 2.7255 (mK)"),
    ("redshifts.lens", 1e-8, "expected 0.01 to 3"),
    ("redshifts.source", 197263.0, "did you mean 0.657999 (c z in km/s)"),
    ("dark_matter.m_th_kev", [1000, 5000], "expected 0.05 to 100 keV; did you mean [1, 5] (eV)"),
    ("dark_matter.m_th_kev", [0.001, 0.005], "did you mean [1, 5] (MeV)"),
    ("dark_matter.m_th_kev", [1.0, 5000.0], "expected 0.05 to 100 keV; to keep it"),
    ("halos.field_half_width_arcsec", 5600, "did you mean 5.6 (mas)"),
    ("halos.min_mass_msun", 7.0, "did you mean 1e+07 (log10)"),
    ("halos.min_mass_msun", 0.001, "did you mean 1e+07 (in 1e10 Msun)"),
    ("halos.concentration_mass_slope", 0.072, "did you mean -0.072 (the sign)"),
    ("halos.concentration_scatter_dex", 16.0, "did you mean 0.16 (percent)"),
    ("observation.simulated.pixel_scale_arcsec", 50.0, "did you mean 0.05 (mas)"),
    ("observation.simulated.pixel_scale_arcsec", 1.39e-5, "did you mean 0.05004 (degrees)"),
    ("observation.simulated.truth.m_th_kev", 4500.0, "did you mean 4.5 (eV)"),
    (f"{BAND}.wavelength_nm", 8050.0, "did you mean 805 (Angstrom)"),
    (f"{BAND}.wavelength_nm", 0.805, "did you mean 805 (microns)"),
    (f"{BAND}.exposure_s", 0.55, "did you mean 1980 (hours) or 550 (ks)"),
    ("smooth_model.quasar_images", [[-2037.0, 520.0]] * 4, "did you mean [[-2.037, 0.52], [-2.037, 0.52], "),
    ("smooth_model.source.beta_arcsec", 180.0, "did you mean 0.18 (mas)"),
    ("smooth_model.source.center", [172.9644, -12.5329], "expected -100 to 100 arcsec, not pixels; did you mean"),
    ("smooth_model.fit.quasar_sigma_arcsec", 5.0, "did you mean 0.005 (mas)"),
    ("smooth_model.fit.source_beta", [60.0, 500.0, None], "did you mean [0.06, 0.5, None] (mas)"),
    ("scan.step_arcsec", 1.4e-4, "did you mean 0.504 (degrees)"),
    ("scan.perturber.theta_e_arcsec", 10.0, "did you mean 0.01 (mas)"),
    ("deflections.filter_arcsec", 400.0, "did you mean 0.4 (mas)"),
]


@fault(
    "Images",
    "a number in another unit",
    "h for H0, eV for keV, mas or degrees for arcsec, and 25 more",
    quick=True,
)
@pytest.mark.parametrize(("key", "value", "meant"), MISTAKES)
def test_a_number_in_another_unit_is_asked_about(
    paper: dict[str, Any], key: str, value: Any, meant: str, outcome: Outcome
) -> None:
    raw = changed(paper, key, value)
    with pytest.raises(ConfigError) as error:
        parse_config(raw)
    (line,) = error.value.problems
    assert line.startswith(f"{key} = ")
    assert meant in line
    outcome.stops(line, "to keep it, add")
    assert line.endswith(f"; to keep it, add {key} to the list `unusual`")
    assert parse_config({**raw, "unusual": [key]}).unusual == [key]


@pytest.mark.parametrize(
    ("key", "value", "meant"),
    [
        ("cosmology.Om0", 31.5, "got 31.5; did you mean 0.315 (percent)"),
        ("abc.fraction", 5, "got 5; did you mean 0.05 (percent)"),
        ("dark_matter.log10_m_halo_msun", [1e13, 3e13], "did you mean [13, 13.4771] (Msun, not its log10)"),
        ("dark_matter.log10_m_halo_msun", [3.0, 3.5], "did you mean [13, 13.5] (log10 in 1e10 Msun)"),
        ("dark_matter.log10_m_halo_msun", [29.9, 31.0], "(a natural logarithm)"),
        ("observation.simulated.truth.log10_m_halo_msun", 2e13, "did you mean 13.301 (Msun, not its log10)"),
        ("smooth_model.source.n_max", 500, "got 500"),
    ],
)
def test_an_impossible_number_has_its_mistake_named(
    paper: dict[str, Any], key: str, value: Any, meant: str
) -> None:
    with pytest.raises(ConfigError) as error:
        parse_config(changed(paper, key, value))
    (line,) = error.value.problems
    assert meant in line


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("dark_matter.m_th_kev", [0.05, 100.0]),
        ("observation.simulated.truth.m_th_kev", float("inf")),
        ("observation.simulated.pixel_scale_arcsec", 0.001),
        ("observation.simulated.pixel_scale_arcsec", 0.3),
        ("redshifts", {"lens": 0.0141, "source": 11.9}),
        ("redshifts", {"lens": 2.9, "source": 6.0}),
        ("halos.min_mass_msun", 1e5),
        ("halos.friction_mass_slope", 1.0),
        ("cosmology", {"H0": 70, "Om0": 0.3, "Ob0": 0.05, "sigma8": 0.8, "ns": 1, "Tcmb0": 2.725}),
        ("scan.window_arcsec", None),
        ("smooth_model.disc_arcsec", None),
        ("smooth_model.fit.quasar_sigma_arcsec", 2e-5),
        ("smooth_model.quasar_images", [[-45.0, 31.0]] * 4),
    ],
)
def test_what_the_field_uses_is_not_asked_about(paper: dict[str, Any], key: str, value: Any) -> None:
    """Warm and cold truths, adaptive optics, radio and Euclid's pixels, near, far and cluster lenses."""
    assert list(questions(parse_block(Config, changed(paper, key, value)))) == []


@pytest.mark.parametrize("overlay", [*OVERLAYS, ROOT / "docs/examples/own_lens.yaml"], ids=lambda path: path.stem)
def test_shipped_overlays_ask_nothing(overlay: Path) -> None:
    assert list(questions(load_config([ROOT / "config.yaml", overlay]))) == []


def test_one_line_per_key_and_none_of_an_observation_that_is_not_used(paper: dict[str, Any]) -> None:
    wrong = changed(changed(paper, "cosmology.H0", 0.7), "observation.simulated.pixel_scale_arcsec", 50.0)
    with pytest.raises(ConfigError) as error:
        parse_config(wrong)
    assert [line.split(" = ")[0] for line in error.value.problems] == [
        "cosmology.H0",
        "observation.simulated.pixel_scale_arcsec",
    ]
    with pytest.raises(ConfigError) as error:
        parse_config({**wrong, "unusual": ["cosmology.H0"]})
    assert len(error.value.problems) == 1
    files = {
        "F814W": {"science": "sci.fits", "psf": "psf.fits", "pixel_scale_arcsec": 50.0, "center_pixel": [9, 9]}
    }
    fits = {**wrong["observation"], "kind": "fits", "bands": ["F814W"], "fits": files}
    with pytest.raises(ConfigError) as error:
        parse_config({**wrong, "observation": fits})
    assert [line.split(" = ")[0] for line in error.value.problems] == [
        "cosmology.H0",
        "observation.fits.F814W.pixel_scale_arcsec",
    ]


def test_unusual_names_keys(paper: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as error:
        parse_config({**paper, "unusual": ["cosmology.h0", f"{BAND}.sky", "nothing"]})
    assert error.value.problems == [
        "unusual: 'cosmology.h0' is no key; did you mean cosmology.H0?",
        "unusual: 'nothing' is no key; remove it",
    ]


def test_the_answer_changes_no_stage_and_no_stored_configuration(paper: dict[str, Any], tmp_path: Path) -> None:
    plain, answered = parse_config(paper), parse_config({**paper, "unusual": ["cosmology.H0"]})
    assert stage_digests(plain) == stage_digests(answered)
    assert "unusual" not in plain.model_dump_json()
    assert parse_config(json.loads(answered.model_dump_json())) == answered
    stored = tmp_path / "config.json"
    stored.write_text(json.dumps(changed(paper, "cosmology.H0", 0.7)))
    assert read_stored(stored).cosmology.H0 == 0.7  # what was computed once can be read


def test_every_number_with_a_unit_has_a_usual_range() -> None:
    """A key that is added later has one too; what is counted or chosen needs none."""

    def fields(block: type[BaseModel]) -> Iterator[tuple[str, Any]]:
        for name, field in block.model_fields.items():
            yield f"{block.__name__}.{name}", field

    from warmlens.config import model, observation, scan, smooth_model

    blocks = {
        block.__name__: block
        for module in (model, observation, scan, smooth_model)
        for block in vars(module).values()
        if isinstance(block, type) and issubclass(block, BaseModel)
    }
    units = ("_arcsec", "_msun", "_kev", "_nm", "_dex", "_sigma", "_rms", "exposure_s")
    marked = {key: any(isinstance(mark, Usual) for mark in field.metadata)
              for block in blocks.values() for key, field in fields(block) if key.endswith(units)}  # fmt: skip
    assert len(marked) > 25
    assert [key for key, usual in marked.items() if not usual] == []
