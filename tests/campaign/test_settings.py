"""What jobs read beside artifacts: lists of thousands of inputs, as files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from warmlens.artifacts.names import FILES, SETTINGS
from warmlens.campaign.files import stage_files
from warmlens.campaign.settings import read_paths, write_settings
from warmlens.cli import stages
from warmlens.config.model import Config
from warmlens.config.types import ConfigError
from warmlens.stages import job

from ..reliability import Outcome, fault


@fault("Machine", "a campaign of thousands of chunks", "3,000 artifacts for one job", quick=True)
def test_a_job_of_3000_chunks_gets_its_inputs(
    paper_config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, outcome: Outcome
) -> None:
    """The shell takes 128 KiB of arguments."""
    monkeypatch.chdir(tmp_path)
    block = paper_config.campaign.model_copy(update={"n_samples": 60_000, "chunk_size": 20})
    config = paper_config.model_copy(update={"results": "results/many", "campaign": block})
    write_settings(config)
    jobs: list[Any] = []
    monkeypatch.setattr(job, "run_job", jobs.append)
    root = Path(config.results)
    lists = {"summaries": "summaries", "smooth_model": "", "observed_summary": ""}
    words = [
        "stage",
        "abc",
        "--settings",
        str(root / SETTINGS.format(stage="abc")),
        "--output",
        str(root / "abc.h5"),
    ]
    for name, source in lists.items():
        words += ["--input", f"{name}=@{root / FILES.format(stage=source)}" if source else f"{name}={name}.h5"]
    assert sum(map(len, words)) < 1000
    done = CliRunner().invoke(stages.app, words)
    assert done.exit_code == 0, done.output
    assert jobs[0].paths("summaries") == stage_files(config, "summaries")
    assert len(jobs[0].paths("summaries")) == 3000 and jobs[0].path("smooth_model") == Path("smooth_model.h5")
    outcome.goes_on("the job gets all of them", "nothing")


def test_only_what_is_read_together_is_listed(paper_config: Config, tmp_path: Path) -> None:
    config = paper_config.model_copy(update={"results": str(tmp_path)})
    write_settings(config)
    assert {path.name for path in (tmp_path / "settings").glob("*.files.json")} == {
        "scan_operator.files.json",
        "summaries.files.json",
    }


@pytest.mark.parametrize("content", [None, "", "{}", "[1]", "[[]]", '"one.h5"', "[" * 100_000])
def test_a_list_that_is_none(tmp_path: Path, content: str | None) -> None:
    path = tmp_path / "list.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ConfigError, match=r"list\.json: no list of files"):
        read_paths(f"@{path}")
    path.write_text(json.dumps(["a.h5", "b c.h5"]))
    assert read_paths(f"@{path}") == [Path("a.h5"), Path("b c.h5")]
    assert read_paths("results/@x.h5") == [Path("results/@x.h5")]
