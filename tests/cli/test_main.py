from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from warmlens.campaign.settings import STAGES

ROOT = Path(__file__).parents[2]
WARMLENS = str(Path(sys.executable).parent / "warmlens")


def _run(*arguments: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    return subprocess.run([WARMLENS, *arguments], cwd=cwd, capture_output=True, text=True, check=False)


def test_every_stage_is_a_command() -> None:
    shown = _run("--help").stdout
    assert all(stage.replace("_", "-") in shown for stage in STAGES)


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
    output = tmp_path / "halos.h5"
    done = _run("halos", "--params", params, "--span", "0", "3", "--output", str(output))
    assert done.returncode == 0, done.stderr
    assert "halos: 3 of 3 samples" in done.stderr
    assert output.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("status", "nowhere"), "nowhere/config.json: no such file; is nowhere the results folder"),
        (("result", "nowhere"), "nowhere/abc.h5: no such artifact"),
        (("report", "nowhere"), "nowhere/config.json: no such file"),
        (("show", "nowhere", "0"), "nowhere/config.json: no such file"),
        (("params", "scan"), "unknown stage 'scan'"),
        (("validate", "--configfile", "absent.yaml"), "absent.yaml: no such file"),
    ],
)
def test_errors_end_with_a_message(arguments: tuple[str, ...], message: str) -> None:
    done = _run(*arguments)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(f"warmlens: {message}")
