"""What several folders of tests use, and what the processes of a test run share."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from warmlens.sampling import Span
from warmlens.stage_table import StageSettings
from warmlens.stages.job import make_job, run_job


def run_stage(
    name: str, settings: StageSettings, output: Path, span: Span | None = None, **inputs: Path | list[Path] | None
) -> None:
    """Run a stage on inputs by name; None: an input that is not there."""
    given = {key: path for key, path in inputs.items() if path is not None}
    run_job(make_job(name, settings, output, given, span))


@contextmanager
def shared_folder(tmp_path_factory: pytest.TempPathFactory, name: str) -> Iterator[Path]:
    """A folder for one process at a time: the first finds it empty and fills it, the others wait for it."""
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent  # of all processes
    folder = base / name
    with (base / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        folder.mkdir(exist_ok=True)
        yield folder
