"""One run of a stage: its settings, the artifacts that it reads, and the one that it writes."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Generic, TypeVar

from warmlens.artifacts.file import Artifact, Dataset, open_input
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.config.types import ConfigError
from warmlens.products.time_limit import SAMPLE_SECONDS
from warmlens.sampling import Span
from warmlens.stage_table import STAGES, Stage, StageSettings

Settings = TypeVar("Settings", bound=StageSettings)


@dataclass(frozen=True)
class Job(Generic[Settings]):
    """A run of a stage.

    Attributes
    ----------
    inputs
        Artifacts that it reads, by the names of its row in the table of stages; a list where there are several.
    output
        Artifact to write.
    span
        Samples or positions to compute; None if the inputs say it, or for the whole.
    sample_seconds
        Longest processor time of one sample; a sample that takes longer fails.
    """

    stage: Stage
    settings: Settings
    inputs: Mapping[str, Path | Sequence[Path]]
    output: Path
    span: Span | None = None
    sample_seconds: float = SAMPLE_SECONDS
    started: float = field(default_factory=time.monotonic)

    def path(self, name: str) -> Path:
        """Return the input of a name."""
        path = self.inputs[name]
        assert isinstance(path, Path)  # make_job checks it
        return path

    def paths(self, name: str) -> list[Path]:
        """Return the inputs of a name, of which there may be several."""
        given = self.inputs.get(name, [])
        return [given] if isinstance(given, Path) else list(given)

    @contextlib.contextmanager
    def open(self, name: str) -> Iterator[Artifact]:
        """Open the input of a name, after checking that its stage wrote it."""
        with open_input(self.path(name), self.stage.inputs[name]) as artifact:
            yield artifact

    @property
    def sources(self) -> dict[str, Path]:
        """Every input by the name that the artifact records it under."""
        sources: dict[str, Path] = {}
        for name, given in self.inputs.items():
            sources |= (
                {name: given} if isinstance(given, Path) else {f"{name}/{path.stem}": path for path in given}
            )
        return sources

    def write(
        self,
        datasets: Mapping[str, Dataset],
        metadata: Mapping[str, Any],
        span: Span | None = None,
        seed_key: str = "",
        sources: Mapping[str, Path] | None = None,
    ) -> str:
        """Write the artifact of this run and return its digest.

        Parameters
        ----------
        span
            Samples that it holds; that of the job unless given.
        seed_key
            What keys the random numbers, SAMPLE and BAND standing for the sample and the band.
        sources
            Files that it was made from, where these are not the inputs.
        """
        made_from = self.sources if sources is None else sources
        origin = Provenance(
            self.stage.name, self.settings.as_dict(), made_from, seed_key, span or self.span, self.started
        )
        return write_artifact(self.output, origin, datasets, metadata)


def make_job(
    name: str,
    settings: StageSettings,
    output: Path,
    inputs: Mapping[str, Path | Sequence[Path]] | None = None,
    span: Span | None = None,
    sample_seconds: float = SAMPLE_SECONDS,
) -> Job[StageSettings]:
    """Return a run of a stage, after checking that it has what it needs.

    Raises
    ------
    ConfigError
        If there is no such stage, or if an input or the span is missing or belongs to no input of the stage.
    """
    if name not in STAGES:
        raise ConfigError([f"{name}: no stage of this name; stages are {', '.join(STAGES)}"])
    stage = STAGES[name]
    given = {key: [paths] if isinstance(paths, Path) else list(paths) for key, paths in (inputs or {}).items()}
    problems = [
        f"stage {name}: has no input {key}; its inputs are {_names(stage)}" for key in given.keys() - stage.inputs
    ]
    checked: dict[str, Path | Sequence[Path]] = {}
    for key, source in stage.inputs.items():
        paths = given.get(key, [])
        if stage.reads_all_of(source) and paths:
            checked[key] = paths
        elif len(paths) == 1:
            checked[key] = paths[0]
        elif paths or not stage.may_lack(source):
            problems.append(f"stage {name}: needs --input {key}=FILE of stage {source}, got {len(paths)}")
    if stage.needs_span and span is None:
        problems.append(f"stage {name}: needs --span START STOP, the samples or positions to compute")
    if problems:
        raise ConfigError(problems)
    return Job(stage, settings, checked, output, span, sample_seconds)


def run_job(job: Job[StageSettings]) -> None:
    """Read the inputs of a stage, do its work, write its artifact."""
    module, _, function = job.stage.work.partition(":")
    getattr(import_module(f"warmlens.stages.{module}"), function)(job)


def _names(stage: Stage) -> str:
    return ", ".join(stage.inputs) or "none"
