"""How far a campaign is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from warmlens.artifacts import ArtifactError, open_artifact
from warmlens.config import Config
from warmlens.config_file import parse_config
from warmlens.layout import CHUNKED, CONFIG, stage_files
from warmlens.stages.settings import STAGES


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
    import json

    path = results / CONFIG
    if not path.is_file():
        raise ArtifactError(
            f"{path}: no such file; is {results} the results folder of a campaign that was started?"
        )
    return parse_config(json.loads(path.read_text())).model_copy(update={"results": str(results)})


def campaign_status(config: Config) -> list[StageStatus]:
    """Status of every stage, from the artifacts that are there."""
    found = []
    for stage in STAGES:
        files = stage_files(config, stage)
        done = [path for path in files if path.exists()]
        seconds, samples, failed = [], 0, 0
        for path in done:
            with open_artifact(path, stage) as artifact:
                seconds.append(artifact.wall_seconds)
                if stage in CHUNKED:
                    bad = artifact.array("samples/status") != 0
                    samples += int((~bad).sum())
                    failed += int(bad.sum())
        found.append(
            StageStatus(
                stage,
                len(done),
                len(files),
                samples if stage in CHUNKED else None,
                failed,
                float(np.mean(seconds)) if seconds else None,
            )
        )
    return found


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
            "unknown" if left is None else _duration(left),
        )
    console = Console()
    console.print(table)
    known = sum(row.seconds_left or 0.0 for row in stages)
    unknown = [row.stage for row in stages if row.seconds_left is None]
    text = f"about {_duration(known / cores)} left on {cores} cores"
    console.print(text + (f", and {', '.join(unknown)}, not yet timed" if unknown else ""))


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
