from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from warmlens.artifacts.file import open_artifact
from warmlens.cli.stages import translate
from warmlens.stage_table import STAGES

ROOT = Path(__file__).parents[2]
WARMLENS = str(Path(sys.executable).parent / "warmlens")


def _run(*arguments: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    return subprocess.run([WARMLENS, *arguments], cwd=cwd, capture_output=True, text=True, check=False)


def test_an_unknown_stage_and_missing_inputs_are_named() -> None:
    unknown = _run("stage", "scan", "--settings", "{}", "--output", "x.h5")
    assert unknown.returncode == 1
    assert all(stage in unknown.stderr for stage in STAGES)
    settings = _run("params", "deflections").stdout
    missing = _run("stage", "deflections", "--settings", settings, "--output", "x.h5", "--input", "halo=h.h5")
    assert missing.returncode == 1
    assert "has no input halo; its inputs are halos, observation" in missing.stderr
    assert "needs --input observation=FILE of stage observation, got 0" in missing.stderr
    absent = _run("stage", "halos", "--settings", "absent.json", "--output", "x.h5")
    assert "absent.json: not readable as JSON" in absent.stderr and "warmlens params halos" in absent.stderr
    stale = _run(
        "stage",
        "deflections",
        "--settings",
        settings.replace('"stage_version":2', '"stage_version":1'),
        "--output",
        "x",
    )
    assert "stage_version is 1, the code of deflections has 2" in stale.stderr
    of_mocks = _run("params", "mocks").stdout
    wrong = _run("stage", "halos", "--settings", of_mocks, "--output", "x.h5", "--span", "0", "3")
    assert "halos: missing" in wrong.stderr


def test_validate(tmp_path: Path) -> None:
    good = _run("validate", "--configfile", "workflow/configs/ci.yaml")
    assert good.returncode == 0
    assert "24 samples in 2 chunks" in good.stdout
    (tmp_path / "bad.yaml").write_text("campaign: {n_samples: 0}\nscan: {stepp: 1}\n")
    bad = _run("validate", "--configfile", str(tmp_path / "bad.yaml"))
    assert bad.returncode == 1
    assert len(bad.stderr.splitlines()) == 2
    assert "campaign.n_samples: input should be greater than or equal to 1, got 0" in bad.stderr
    assert "scan.stepp: unknown key" in bad.stderr


def test_a_stage_runs_by_hand(tmp_path: Path) -> None:
    params = _run("params", "halos", "--configfile", "workflow/configs/ci.yaml").stdout
    assert json.loads(params)["halos"]["preset"] == "calibrated"
    (tmp_path / "halos.json").write_text(params)
    span = ("--span", "0", "3", "--output")
    done = _run("stage", "halos", "--settings", str(tmp_path / "halos.json"), *span, str(tmp_path / "halos.h5"))
    assert done.returncode == 0, done.stderr
    assert "halos: 3 of 3 samples" in done.stderr
    old = _run("halos", "--params", params, *span, str(tmp_path / "old.h5"))  # as version 0.1 called it
    assert old.returncode == 0, old.stderr
    assert "`warmlens halos` is now `warmlens stage halos`" in old.stderr
    with open_artifact(tmp_path / "halos.h5") as new, open_artifact(tmp_path / "old.h5") as before:
        assert new.digest == before.digest


def test_commands_of_stages_as_they_were_are_translated() -> None:
    words = [
        "null-scans",
        "--params",
        "{}",
        "--mocks",
        "m",
        "--design",
        "d",
        "--shard",
        "a",
        "--shard",
        "b",
        "--output",
        "o",
    ]
    expected = "stage null_scans --settings {} --input mocks=m --input design=d --input shards=a --input shards=b"
    assert translate(words) == [*expected.split(), "--output", "o"]
    words = [
        "abc",
        "--params",
        "{}",
        "--summary",
        "s",
        "--null-summaries",
        "n",
        "--output",
        "o",
        "--table",
        "t",
        "--numbers",
        "j",
    ]
    expected = "stage abc --settings {} --input summaries=s --input null_summaries=n --output o"
    assert translate(words) == expected.split()
    assert translate(["status", "results/a"]) == ["status", "results/a"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("status", "nowhere"), "nowhere/config.json: no such file; is nowhere the results folder"),
        (("result", "nowhere"), "nowhere/config.json: no such file"),
        (("report", "nowhere"), "nowhere/config.json: no such file"),
        (("show", "nowhere", "0"), "nowhere/config.json: no such file"),
        (("params", "scan"), "unknown stage 'scan'"),
        (("validate", "--configfile", "absent.yaml"), "absent.yaml: no such file"),
        (("audit", "a" * 256), f"{'a' * 256}/config.json: File name too long"),
        (("result", "a" * 256), f"{'a' * 256}/config.json: File name too long"),
        (("validate", "--configfile", "a" * 256), f"{'a' * 256}: File name too long"),
        (("status", "[bold]y"), "[bold]y/config.json: no such file"),
        (("status", "\x1b[31mred"), r"\x1b[31mred/config.json: no such file"),
    ],
)
def test_errors_end_with_a_message(arguments: tuple[str, ...], message: str) -> None:
    done = _run(*arguments)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(f"warmlens: {message}")
    assert "Traceback" not in done.stderr or arguments[0] == "params"
