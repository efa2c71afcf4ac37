"""How far a campaign is: what is counted, what is opened, and how much time is left."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Dataset
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.campaign import status
from warmlens.campaign.files import note_file, stage_files
from warmlens.campaign.status import (
    StageStatus,
    campaign_status,
    failure_lines,
    failures,
    note_ended,
    print_status,
    progress_line,
)
from warmlens.config.model import Config

from ..reliability import Outcome, fault


@pytest.fixture
def config(paper_config: Config, tmp_path: Path) -> Config:
    return paper_config.model_copy(update={"results": str(tmp_path)})


def _write_chunk(path: Path, failed: list[int]) -> None:
    data = Dataset(np.array(failed, dtype=np.uint8), "", ("sample",), "0: good")
    start, stop = (int(edge) for edge in path.stem.split("-")[1:])
    write_artifact(path, Provenance("halos", {}, span=(start, stop)), {"samples/status": data}, {})


def _row(config: Config, stage: str) -> StageStatus:
    return next(row for row in campaign_status(config) if row.stage == stage)


def test_samples_are_counted_and_a_recomputed_artifact_is_read_again(config: Config) -> None:
    first, second, *_ = stage_files(config, "halos")
    _write_chunk(first, [0, 0, 1])
    _write_chunk(second, [0, 0, 0])
    row = _row(config, "halos")
    assert (row.n_done, row.n_samples, row.n_failed) == (2, 5, 1)
    _write_chunk(second, [1, 1, 1])
    os.utime(second, ns=(0, 1))
    row = _row(config, "halos")
    assert (row.n_done, row.n_samples, row.n_failed) == (2, 2, 4)
    first.unlink()
    assert _row(config, "halos").n_done == 1


def test_an_artifact_is_opened_once(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    """The line of progress comes every few seconds, and a campaign has hundreds of artifacts."""
    _write_chunk(stage_files(config, "halos")[0], [0])
    before = campaign_status(config)
    monkeypatch.setattr(status, "open_artifact", None)
    assert campaign_status(config) == before


def test_a_damaged_artifact_is_named(config: Config) -> None:
    path = stage_files(config, "halos")[0]
    path.parent.mkdir(parents=True)
    path.write_bytes(b"no HDF5")
    with pytest.raises(ArtifactError, match=f"{path.name}: not a readable HDF5 file"):
        campaign_status(config)


def _stages(*seconds_and_done: tuple[float | None, int]) -> list[StageStatus]:
    return [StageStatus(f"s{i}", done, 4, None, 0, each) for i, (each, done) in enumerate(seconds_and_done)]


@pytest.mark.parametrize(
    ("stages", "line"),
    [
        (_stages((9.0, 4)), "4 of 4 artifacts; figures and the report are left"),
        (_stages((None, 0)), "0 of 4 artifacts; time left not known yet (s0 not yet timed)"),
        (_stages((9.0, 4), (8.0, 1)), "5 of 8 artifacts; s1 1 of 4; about 12 s left on 2 cores"),
        (
            _stages((9.0, 3), (None, 0)),
            "3 of 8 artifacts; s0 3 of 4; more than 4 s left on 2 cores (s1 not yet timed)",
        ),
        (_stages(*[(None, 0)] * 5), "0 of 20 artifacts; time left not known yet (5 stages not yet timed)"),
    ],
)
def test_line_of_progress(stages: list[StageStatus], line: str) -> None:
    assert progress_line(stages, 2) == line


def _log(config: Config, stage: str, text: str, span: tuple[int, int] | None = None) -> Path:
    path = note_file(config, stage, "logs", span)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


TRACEBACK = "12:00:00 ERROR where it happened\nTraceback (most recent call last):\n  File x\nValueError: bad\n"


@fault("Machine", "a job fails", "a typo in a lens model, and jobs that were killed", quick=True)
def test_a_failed_job_is_one_line_until_it_is_run_again(config: Config, outcome: Outcome) -> None:
    log = _log(config, "smooth_model", f"{TRACEBACK}warmlens: EPLL is no lens model;\n  known are EPL, SIE\n")
    mocks = _log(config, "mocks", "10:00:00 INFO sample 3\n", (250, 500))
    assert [failure.what for failure in failures(config)] == ["smooth_model"], "mocks may be running"
    note_ended([mocks, log, log.with_name("none.log")])
    lines = failure_lines(config)
    assert failure_lines(config, log.stat().st_mtime + 60.0) == []
    assert len(lines) == 2 and not any("\n" in line for line in lines)
    assert lines[0] == f"warmlens: smooth_model: EPLL is no lens model; known are EPL, SIE; log: {log}"
    assert lines[1].startswith("warmlens: mocks, samples 250 to 500: ended without a message: killed, or out of")
    outcome.stops(lines[0], "EPLL is no lens model; known are EPL, SIE", str(log))
    log.write_text("12:01:00 INFO reading\n")  # started again
    _write_chunk(stage_files(config, "halos")[0], [0])
    _log(config, "halos", "warmlens: of an earlier start", (0, 250))
    assert [failure.what for failure in failures(config)] == ["mocks, samples 250 to 500"]


def test_failed_figures_and_report(config: Config) -> None:
    for name in ("figures/answer", "report"):
        path = Path(config.results) / f"logs/{name}.log"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("psf: drawn\nwarmlens: the disk is full\n")
    assert [failure.what for failure in failures(config)] == ["figures answer", "report"]


def test_many_and_long_failures_are_counted_and_shortened(config: Config) -> None:
    for number in range(8):
        _log(config, "halos", f"warmlens: {'long ' * 1000}", (250 * number, 250 * (number + 1)))
    lines = failure_lines(config)
    assert lines[0].startswith("3 more jobs failed, see `warmlens status ") and len(lines) == 6
    assert max(map(len, lines)) < 460 + len(str(failures(config)[0].log)) and "..." in lines[1]


def test_status_prints_failures(config: Config, capsys: pytest.CaptureFixture[str]) -> None:
    _log(config, "smooth_model", "warmlens: [bold]EPLL[/] is no lens model")
    print_status(campaign_status(config), failures(config), 2)
    assert "failed: smooth_model: [bold]EPLL[/] is no lens model; log: " in capsys.readouterr().out
