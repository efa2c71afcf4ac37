"""docs/configuration.md is made from the models and from the comments of config.yaml."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from warmlens.cli.main import app
from warmlens.config.model import Config
from warmlens.config.reference import comments, explanations, keys, missing, reference

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "config.yaml").read_text()


def test_the_document_is_up_to_date(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    made = CliRunner().invoke(app, ["config-reference", "--output", str(tmp_path / "made.md")])
    assert made.exit_code == 0, made.output
    document = (ROOT / "docs/configuration.md").read_text()
    assert document == (tmp_path / "made.md").read_text(), "run `make docs`"


def test_every_key_is_explained_and_documented() -> None:
    assert missing(TEXT) == []
    document = reference(TEXT)
    sections = document.split("\n## ")[1:]
    assert [section.split("\n")[0] for section in sections] == list(Config.model_fields)
    rows = {
        f"{section.splitlines()[0]}.{line.split('`')[1]}"
        for section in sections
        for line in section.splitlines()
        if line.startswith("| `")
    }
    assert rows == {".".join(key.path) for key in keys() if len(key.path) > 1}


@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("campaign.seed", "integer >= 0"),
        ("halos.preset", "`paper` \\| `calibrated` \\| `custom`"),
        ("observation.fits.BAND.exposure_s", "number > 0 or `null`"),
        ("smooth_model.fit.tolerance", "number > 0, < 1"),
        ("scan.window_arcsec", "[number > 0, number > 0] or `null`"),
    ],
)
def test_types_and_ranges_are_those_of_the_models(path: str, kind: str) -> None:
    assert {".".join(key.path): key.kind for key in keys()}[path] == kind


def test_comments_belong_to_their_keys() -> None:
    found = comments(
        "a:  # of a\n"
        "  b: {c: 1}  # of b\n"
        "                                # and more\n"
        "  # d: 1.0   # of a key that is switched off\n"
        "  # e:       # a block that is\n"
        "  #   f: 2   # key in it\n"
        "g: '#no'     # of g\n"
    )
    assert found == {
        ("a",): "of a",
        ("a", "b"): "of b and more",
        ("a", "d"): "of a key that is switched off",
        ("a", "e"): "a block that is",
        ("a", "e", "f"): "key in it",
        ("g",): "of g",
    }


def test_a_comment_without_a_key_and_a_key_without_a_comment_are_found() -> None:
    with pytest.raises(ValueError, match=r"abc\.fractoin, which is no key"):
        explanations(TEXT.replace("  fraction: 0.05 ", "  fractoin: 0.05 "))
    silent = "\n".join(line.split("#")[0] if "sigma8" in line else line for line in TEXT.splitlines())
    assert missing(silent) == ["cosmology.sigma8"]
    with pytest.raises(ValueError, match=r"no comment on cosmology\.sigma8"):
        reference(silent)
