"""Comments of config.yaml, docs/configuration.md and the JSON schema come from the types of the configuration."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator  # Snakemake depends on it, so it is always installed
from typer.testing import CliRunner

from warmlens.cli.main import app
from warmlens.config.model import Config
from warmlens.config.reference import SCHEMA, document, generated_files, keys, with_comments

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "config.yaml").read_text()
# files of systematics hold a base and variants: they are no overlays
OVERLAYS = sorted(path for path in (ROOT / "workflow/configs").glob("*.yaml") if "systematics" not in path.stem)
FILES = [ROOT / "config.yaml", *OVERLAYS]


@pytest.mark.parametrize("path", generated_files(TEXT))
def test_generated_files_are_up_to_date(path: str) -> None:
    assert (ROOT / path).read_text() == generated_files(TEXT)[path], "run `make docs`"


def test_the_command_writes_all_files_and_restores_comments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = [re.sub(r"(?<=: 1131 ).*|(?<=: paper ) +# .*", "", line) for line in TEXT.splitlines()]
    lines = [line for line in lines if not line.startswith(" " * 32 + "#")]
    assert lines != TEXT.splitlines()
    (tmp_path / "config.yaml").write_text("\n".join(lines))
    monkeypatch.chdir(tmp_path)
    outcome = CliRunner().invoke(app, ["config-reference"])
    assert outcome.exit_code == 0, outcome.output
    for path in generated_files(TEXT):
        assert (tmp_path / path).read_text() == (ROOT / path).read_text()


def test_the_command_leaves_an_invalid_configuration_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = TEXT.replace("  seed: 1131  ", "  seed: -1  ")
    (tmp_path / "config.yaml").write_text(broken)
    monkeypatch.chdir(tmp_path)
    assert CliRunner().invoke(app, ["config-reference"]).exit_code != 0
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]
    assert (tmp_path / "config.yaml").read_text() == broken


def test_comments_belong_to_their_keys_and_other_lines_stay() -> None:
    text = TEXT.replace("min_mass_msun: 1.0e+7 ", "min_mass_msun: '#no' ")
    text = text.replace("mocks:  ", "# a heading\n\nmocks: # old ")
    text = text.replace("sky: 0.0044\n", "sky: 0.0044  # mine\n")
    lines = with_comments(text).splitlines()
    assert "  min_mass_msun: '#no'          # " in "\n".join(lines)
    assert "        sky: 0.0044  # mine" in lines  # of the second band; the first one's line explains the key
    heading = lines.index("# a heading")
    assert lines[heading + 1] == ""
    assert lines[heading + 2] == "mocks:                          # Positions of the quasar images in the mocks"
    assert yaml.safe_load(with_comments(TEXT)) == yaml.safe_load(TEXT)


def test_a_line_without_a_key_and_a_key_without_a_line_are_refused() -> None:
    for changed in ("  fractoin: 0.05 ", "  # fractoin: 0.05 "):
        with pytest.raises(ValueError, match=r"config\.yaml has abc\.fractoin, which is no key"):
            with_comments(TEXT.replace("  fraction: 0.05 ", changed))
    absent = "\n".join(line for line in TEXT.splitlines() if "sigma8" not in line and "mask.fits" not in line)
    with pytest.raises(ValueError, match=r"no line for cosmology\.sigma8, observation\.fits\.BAND\.mask; add one"):
        with_comments(absent)


def test_every_key_is_explained_and_documented() -> None:
    assert [key.path for key in keys() if not key.meaning] == []
    sections = document(TEXT).split("\n## ")[1:]
    assert [section.split("\n")[0] for section in sections] == list(Config.model_fields)
    rows = {
        f"{section.splitlines()[0]}.{line.split('`')[1]}"
        for section in sections
        for line in section.splitlines()
        if line.startswith("| `")
    }
    assert rows == {".".join(key.path) for key in keys() if len(key.path) > 1}


def test_every_choice_is_explained() -> None:
    for key in keys():
        for choice in re.findall(r"`([a-z]\w+)`", key.kind):
            if choice not in ("true", "false", "null"):
                assert choice in key.meaning, f"{'.'.join(key.path)} does not explain {choice}"


@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("campaign.seed", "integer >= 0"),
        ("halos.preset", "`paper` \\| `calibrated` \\| `custom`"),
        ("observation.fits.BAND.exposure_s", "number > 0 or `null`, usually 5 to 1e+07"),
        ("smooth_model.fit.tolerance", "number > 0 and < 1"),
        ("scan.window_arcsec", "[number > 0, number > 0] or `null`, usually 0.2 to 200"),
        ("scan.shard_size", "integer >= 1 and <= 9999999"),
    ],
)
def test_types_and_ranges_are_those_of_the_models(path: str, kind: str) -> None:
    assert {".".join(key.path): key.kind for key in keys()}[path] == kind


# ---------------------------------------------------------------------------------------- schema for editors


@pytest.fixture(scope="module")
def schema() -> Draft202012Validator:
    content = json.loads((ROOT / SCHEMA).read_text())
    Draft202012Validator.check_schema(content)
    return Draft202012Validator(content)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_schema_accepts_every_shipped_file_and_each_names_it(path: Path, schema: Draft202012Validator) -> None:
    text = path.read_text()
    assert [error.message for error in schema.iter_errors(yaml.safe_load(text))] == []
    name = text.splitlines()[0].removeprefix("# yaml-language-server: $schema=")
    assert (path.parent / name).resolve() == ROOT / SCHEMA


@pytest.mark.parametrize(
    ("overlay", "reason"),
    [
        ({"campain": {"seed": 1}}, "'campain' was unexpected"),
        ({"halos": {"min_mas_msun": 1e7}}, "'min_mas_msun' was unexpected"),
        ({"smooth_model": {"fit": {"search": {"n_max": 21}}}}, "21 is greater than the maximum of 20"),
        ({"observation": {"fits": {"F814W": {"sciense": "a.fits"}}}}, "'sciense' was unexpected"),
        ({"redshifts": {"lens": -0.3}}, "-0.3 is less than or equal to the minimum of 0"),
        ({"campaign": {"n_samples": "many"}}, "'many' is not of type 'integer'"),
        ({"halos": {"preset": "best"}}, "'best' is not one of"),
    ],
)
def test_the_schema_refuses_unknown_keys_and_values(
    overlay: dict[str, Any], reason: str, schema: Draft202012Validator
) -> None:
    def messages(error: Any) -> list[str]:
        return [error.message, *(text for inner in error.context for text in messages(inner))]

    assert any(reason in text for error in schema.iter_errors(overlay) for text in messages(error))
