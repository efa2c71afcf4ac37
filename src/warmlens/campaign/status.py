"""How far a campaign is, and how much time is left."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.names import CHUNKED, CONFIG, NULL
from warmlens.campaign.files import note_file, stage_file, stage_files, stage_spans
from warmlens.config.file import read_stored
from warmlens.config.model import Config
from warmlens.stage_table import STAGES, campaign_stages
from warmlens.text import Terminal, duration

_SAMPLED = (*CHUNKED, *NULL)
_MAX_NAMED = 3  # stages in a line of progress; the others are counted
_MAX_FAILURES = 5  # in the last lines of a run
_ERROR = "warmlens: "  # how a command ends that failed
_TAIL = 2**16  # bytes of a log that are searched for it
_WIDEST = 400  # of a reason


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


@dataclass(frozen=True)
class Failure:
    """A job that failed and has not been run again: what it was to make, why it failed, and its log."""

    what: str
    reason: str
    log: Path

    def __str__(self) -> str:
        return f"{self.what}: {self.reason}; log: {self.log}"


def failures(config: Config) -> list[Failure]:
    """Return the jobs that failed, from their logs: a job that is run again starts a new one."""
    failed = []
    for stage in campaign_stages(config):
        for span in stage_spans(config, stage):
            log = note_file(config, stage, "logs", span)
            if not stage_file(config, stage, span).exists() and (reason := _last_error(log)):
                kind = "samples" if STAGES[stage].by_sample else "positions"
                failed.append(Failure(stage + (f", {kind} {span[0]} to {span[1]}" if span else ""), reason, log))
    logs = Path(config.results) / "logs"
    others = {log: f"figures {log.stem}" for log in sorted((logs / "figures").glob("*.log"))}
    others |= {logs / f"{name}.log": name for name in ("report", "manifest")}
    return failed + [Failure(what, reason, log) for log, what in others.items() if (reason := _last_error(log))]


def failure_lines(config: Config, since: float = 0.0) -> list[str]:
    """Return a line for each job that failed after a time [s since the epoch]; of many the last few."""
    recent = [failure for failure in failures(config) if failure.log.stat().st_mtime >= since - 1.0]
    lines = [f"{_ERROR}{failure}" for failure in recent]
    n_left = len(lines) - _MAX_FAILURES
    more = f"{n_left} more jobs failed, see `warmlens status {config.results}`"
    return lines if n_left <= 0 else [more, *lines[n_left:]]


def note_ended(logs: Sequence[Path]) -> None:
    """Add to the logs of failed jobs without a message that they were ended from outside."""
    for log in logs:
        if log.is_file() and not _last_error(log):
            with log.open("a", encoding="utf-8") as handle:
                handle.write(f"\n{_ERROR}ended without a message: killed, or out of memory or time\n")


def _last_error(log: Path) -> str:
    """Return the message that a command ended with, as one line; "" if it ended well or has not ended."""
    if not log.is_file():
        return ""
    text = log.read_bytes()[-_TAIL:].decode(errors="replace")
    start = text.rfind(f"\n{_ERROR}")
    start = start + 1 if start >= 0 else 0
    if not text.startswith(_ERROR, start):
        return ""
    message = " ".join(text[start:].removeprefix(_ERROR).split())
    return message if len(message) <= _WIDEST else f"{message[:_WIDEST]}..."


def progress_line(stages: list[StageStatus], cores: int) -> str:
    """Return in one line how far a campaign is: stages under way, and the time left on a number of cores."""
    begun = [row for row in stages if 0 < row.n_done < row.n_files]
    parts = [f"{row.stage} {row.n_done} of {row.n_files}" for row in begun]
    done, total = sum(row.n_done for row in stages), sum(row.n_files for row in stages)
    left = "figures and the report are left" if done == total else _time_left(stages, cores)
    return "; ".join([f"{done} of {total} artifacts", *parts, left])


def print_status(stages: list[StageStatus], failed: Sequence[Failure], cores: int) -> None:
    """Print the status as a table, failed jobs, and the time left on a number of cores."""
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
    for failure in failed:
        console.print(f"failed: {failure}", markup=False, highlight=False, soft_wrap=True)
    console.print(_time_left(stages, cores))


def _time_left(stages: list[StageStatus], cores: int) -> str:
    known = sum(row.seconds_left or 0.0 for row in stages) / cores
    unknown = [row.stage for row in stages if row.seconds_left is None]
    if not unknown:
        return f"about {duration(known)} left on {cores} cores"
    named = ", ".join(unknown) if len(unknown) <= _MAX_NAMED else f"{len(unknown)} stages"
    left = f"more than {duration(known)} left on {cores} cores" if known else "time left not known yet"
    return f"{left} ({named} not yet timed)"
