"""How far a campaign is, and how much time is left."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table

from warmlens.artifacts.file import ArtifactError, open_artifact
from warmlens.artifacts.names import CHUNKED, CONFIG, NULL
from warmlens.campaign.files import stage_files
from warmlens.config.file import read_stored
from warmlens.config.model import Config
from warmlens.stage_table import campaign_stages
from warmlens.text import Terminal, duration

_SAMPLED = (*CHUNKED, *NULL)
_MAX_NAMED = 3  # stages in a line of progress; the others are counted


@dataclass(frozen=True)
class StageStatus:
    """Progress of one stage: artifacts and good samples done, failed samples, mean seconds per artifact."""

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
    """Read the configuration of the last run into a results folder, with this folder as its `results`."""
    path = results / CONFIG
    if not path.is_file():
        raise ArtifactError(
            f"{path}: no such file; is {results} the results folder of a campaign that was started?"
        )
    return read_stored(path).model_copy(update={"results": str(results)})


def campaign_status(config: Config) -> list[StageStatus]:
    """Return the status of every stage, from the artifacts that are there."""
    stages = []
    for stage in campaign_stages(config):
        files = stage_files(config, stage)
        if not files:  # a null test that is switched off
            continue
        done = [_read(path, stage, written) for path in files if (written := _written_ns(path)) is not None]
        seconds, n_good, n_failed = np.array(done).reshape(-1, 3).T
        stages.append(
            StageStatus(
                stage,
                len(done),
                len(files),
                int(n_good.sum()) if stage in _SAMPLED else None,
                int(n_failed.sum()),
                float(np.mean(seconds)) if done else None,
            )
        )
    return stages


def _written_ns(path: Path) -> int | None:
    """Return when a file was written [ns]; None if Snakemake has removed it, to recompute it."""
    try:
        return path.stat().st_mtime_ns
    except FileNotFoundError:
        return None


@functools.cache
def _read(path: Path, stage: str, _written: int) -> tuple[float, int, int]:
    """Read seconds, good and failed samples of an artifact, once: it never changes, a newer one replaces it."""
    with open_artifact(path, stage) as artifact:
        failed = artifact.array("samples/status") != 0 if stage in _SAMPLED else np.empty(0, bool)
        return artifact.wall_seconds, int((~failed).sum()), int(failed.sum())


def progress_line(stages: list[StageStatus], cores: int) -> str:
    """Return in one line how far a campaign is: stages under way, and the time left on a number of cores."""
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
    console = Terminal(soft_wrap=False)
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
