"""The documents that need a finished campaign: their commands and their Python are run on it."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path
from typing import Any, get_args

import pytest

from warmlens.config.model import HalosBlock
from warmlens.halos.dark_matter import ThermalRelic, TransferFunction
from warmlens.inference import summary_sets
from warmlens.stages.summaries import STATISTICS

from .conftest import BIN, ROOT, Project, make_project


def blocks(document: str, language: str) -> list[str]:
    """Fenced blocks of one language."""
    text = (ROOT / "docs" / document).read_text()
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


@pytest.fixture
def as_demo(finished: Project, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which the finished campaign is called results/demo, as in the documents."""
    for name in ("Snakefile", "workflow", "config.yaml", "docs"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "results").mkdir()
    (tmp_path / "results/demo").symlink_to(finished.results)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_rule_of_the_example_is_that_of_the_stage_it_resembles() -> None:
    (shown,) = blocks("extending.md", "snakemake")
    (rule,) = re.findall(r"^rule summaries:\n.*", (ROOT / "workflow/rules/summaries.smk").read_text(), re.M | re.S)
    assert shown == rule.replace("summaries", "islands")


def test_extensions(as_demo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {"__name__": "extending"}
    for code in blocks("extending.md", "python"):
        exec(compile(code, "docs/extending.md", "exec", dont_inherit=True), names)  # as one module
    # the model of the example with the relic's exponents is the relic
    cosmology = names["generator"].cosmology
    relic = ThermalRelic(2.0, cosmology)
    same = names["HalfMode"](relic.half_mode_mass_msun, cosmology, 2.0 * 1.12, 5.0 / 1.12)
    k = names["np"].geomspace(0.1, 300.0, 50)
    assert same.transfer(k) == pytest.approx(relic.transfer(k), rel=1e-6)
    assert same.resolution_msun == pytest.approx(relic.resolution_msun, rel=1e-2)
    assert same.transfer(k[-1]) < 0.5 < same.transfer(k[0])
    assert names["counts"][1e10] < 0.2 * names["counts"][1e7]
    assert all(0.1 < rms < 20.0 for rms in names["deflections"].values())
    # two islands, one of them touching nothing that is valid
    delta_r = names["np"].zeros((2, 4, 5))
    delta_r[0, 0, :2] = delta_r[0, 3, 4] = -11.0
    valid = names["np"].ones((4, 5), dtype=bool)
    assert names["islands_below"](delta_r, valid, -10.0).tolist() == [2.0, 0.0]
    valid[3, 4] = False
    assert names["islands_below"](delta_r, valid, -10.0).tolist() == [1.0, 0.0]
    assert names["analysis"].bounds["q0455"].k == 4
    said = capsys.readouterr().out
    assert "nat over the prior" in said


def test_what_an_extension_has_to_edit_is_there() -> None:
    """The places that docs/extending.md names."""
    assert get_args(HalosBlock.model_fields["transfer_function"].annotation) == get_args(TransferFunction)
    assert STATISTICS.keys() >= set(summary_sets.COUNTS)
    assert "counts" in summary_sets.COUNTS
    assert callable(summary_sets.points)
    assert set(summary_sets.SETS) >= {"paper", "sharper"}


def test_tutorial_commands(as_demo: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    """As they stand, one after the other; the campaign is not run again, but planned where there is none."""
    elsewhere = make_project(tmp_path_factory.mktemp("planned")).folder
    environment = {**os.environ, "NO_COLOR": "1", "PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}"}
    commands = [line for block in blocks("tutorial.md", "sh") for line in block.splitlines()]
    said: dict[str, str] = {}
    for command in commands:
        plan = command.startswith("snakemake")
        done = subprocess.run(
            ["bash", "-c", command + (" --dry-run --quiet rules" if plan else "")],
            capture_output=True,
            text=True,
            check=False,
            env=environment,
            cwd=elsewhere if plan else None,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        said[" ".join(command.split()[:2])] = done.stdout
    assert set(said) == {
        f"warmlens {name}" for name in ("validate", "params", "status", "report", "result", "audit")
    } | {"snakemake --cores"}
    assert "valid: 250 samples" in said["warmlens validate"]
    assert '"mode":"fit"' in said["warmlens params"]
    assert "abc" in said["snakemake --cores"]
    assert "2 of 2" in said["warmlens status"]
    result = said["warmlens result"]
    for line in ("NOT USABLE", "m_TH >", "the prior alone gives 1.07 keV", "posterior:"):
        assert line in result
    explained = tutorial_lines("| question that it answers |")
    explained.remove("expected")  # not printed where so few samples are nearly cold
    for line in explained:
        assert line in result, line
    assert "complete, unaltered" in said["warmlens audit"]
    assert (as_demo / "report.html").stat().st_size > 10_000


def tutorial_lines(heading: str) -> list[str]:
    """First cells of the table that has this in its heading."""
    text = (ROOT / "docs/tutorial.md").read_text()
    rows = text.partition(heading)[2].partition("\n\n")[0].splitlines()[2:]
    return [row.split("|")[1].strip() for row in rows]


def test_tutorial_python(as_demo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {"__name__": "tutorial"}
    for code in blocks("tutorial.md", "python"):
        exec(compile(code, "docs/tutorial.md", "exec", dont_inherit=True), names)
    assert names["delta_r"].data.ndim == 2
    assert "the prior 1.07 keV" in capsys.readouterr().out


def test_tutorial_names_the_figures_of_a_campaign(finished: Project) -> None:
    text = (ROOT / "docs/tutorial.md").read_text()
    named = set(re.findall(r"`(\w+)\.png`", text))
    assert named <= {path.stem for path in (finished.results / "figures").glob("*.png")}
