"""How far a campaign is."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from warmlens.artifacts.file import ArtifactError, open_artifact
from warmlens.artifacts.names import CHUNKED, CONFIG, NULL
from warmlens.campaign.files import stage_files
from warmlens.config.file import read_stored
from warmlens.config.model import Config
from warmlens.stage_table import campaign_stages
from warmlens.text import duration

_SAMPLED = (*CHUNKED, *NULL)
_MAX_NAMED = 3  # stages that a line of progress names


@dataclass(frozen=True)
class StageStatus:
    """Progress of one stage: artifacts and samples done, failed samples, seconds an artifact took."""

    stage: str
    n_done: int
    n_files: int
    n_samples: int | None
    n_failed: int
    seconds: float | None

    @property
    def seconds_left(self) -> float | None:
        """Estimate of the work left [core seconds]; None before the first artifact."""
        left = self.n_files - self.n_done
        if left == 0:
            return 0.0
        return None if self.seconds is None else left * self.seconds


def read_campaign(results: Path) -> Config:
    """Configuration of the last run into a results folder, whose artifacts are looked for there."""
    path = results / CONFIG
    if not path.is_file():
        raise ArtifactError(
            f"{path}: no such file; is {results} the results folder of a campaign that was started?"
        )
    return read_stored(path).model_copy(update={"results": str(results)})


def campaign_status(config: Config) -> list[StageStatus]:
    """Status of every stage, from the artifacts that are there."""
    found = []
    for stage in campaign_stages(config):
        files = stage_files(config, stage)
        if not files:  # a null test that is switched off
            continue
        done = [_read(path, stage, written) for path in files if (written := _written(path)) is not None]
        found.append(
            StageStatus(
                stage,
                len(done),
                len(files),
                sum(item.n_good for item in done) if stage in _SAMPLED else None,
                sum(item.n_failed for item in done),
                float(np.mean([item.seconds for item in done])) if done else None,
            )
        )
    return found


@dataclass(frozen=True)
class _Done:
    seconds: float
    n_good: int
    n_failed: int


def _written(path: Path) -> int | None:
    """When a file was written [ns], None if it is not there: Snakemake removes what it is about to make anew."""
    try:
        return path.stat().st_mtime_ns
    except FileNotFoundError:
        return None


@functools.cache
def _read(path: Path, stage: str, _written_ns: int) -> _Done:
    """What is counted of an artifact, which is opened once: it is never changed, only replaced by a newer one."""
    with open_artifact(path, stage) as artifact:
        if stage not in _SAMPLED:
            return _Done(artifact.wall_seconds, 0, 0)
        failed = artifact.array("samples/status") != 0
        return _Done(artifact.wall_seconds, int((~failed).sum()), int(failed.sum()))


def progress_line(stages: list[StageStatus], cores: int) -> str:
    """How far a campaign is, in one line: stages under way, and the time left on a number of cores."""
    begun = [row for row in stages if 0 < row.n_done < row.n_files]
    parts = [f"{row.stage} {row.n_done} of {row.n_files}" for row in begun]
    done, total = sum(row.n_done for row in stages), sum(row.n_files for row in stages)
    left = "figures and the report are left" if done == total else _time_left(stages, cores)
    return "; ".join([f"{done} of {total} artifacts", *parts, left])


def print_status(stages: list[StageStatus], cores: int) -> None:
    """Print the status as a table, and the time left on a number of cores."""
    table = Table("stage", "artifacts", "samples", "failed", "seconds each", "left", box=None)
    for row in stages:
        left = row.seconds_left
        table.add_row(
            row.stage,
            f"{row.n_done} of {row.n_files}",
            "" if row.n_samples is None else str(row.n_samples),
            str(row.n_failed) if row.n_failed else "",
            "" if row.seconds is None else f"{row.seconds:.1f}",
            "unknown" if left is None else duration(left),
        )
    console = Console()
    console.print(table)
    console.print(_time_left(stages, cores))


def _time_left(stages: list[StageStatus], cores: int) -> str:
    known = sum(row.seconds_left or 0.0 for row in stages) / cores
    unknown = [row.stage for row in stages if row.seconds_left is None]
    if not unknown:
        return f"about {duration(known)} left on {cores} cores"
    named = ", ".join(unknown) if len(unknown) <= _MAX_NAMED else f"{len(unknown)} stages"
    left = f"more than {duration(known)} left on {cores} cores" if known else "time left not known yet"
    return f"{left} ({named} not yet timed)"
