"""How far a campaign is: what is counted, what is opened, and how much time is left."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from warmlens.artifacts.file import ArtifactError, Dataset, Provenance, write_artifact
from warmlens.campaign import status
from warmlens.campaign.files import stage_files
from warmlens.campaign.status import StageStatus, campaign_status, progress_line
from warmlens.config.model import Config


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
