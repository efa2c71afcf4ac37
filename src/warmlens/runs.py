"""Who is at work in a folder: records of running Snakemakes, and whether their lock may be lifted.

Snakemake locks its working folder with files that say nothing of their owner, and a killed one leaves them behind.
"""

from __future__ import annotations

import json
import os
import socket
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import psutil

from warmlens.artifacts import atomic_path

_RECORDS = Path(".snakemake/warmlens-runs")
_LOCKS = Path(".snakemake/locks")


class LockedError(RuntimeError):
    """The working folder is locked, and it is not certain that its owner is gone."""


@dataclass(frozen=True)
class Run:
    """A Snakemake that began in a folder.

    Attributes
    ----------
    host, pid
        Where it runs.
    born
        When its process began [s since the epoch]: a later process may have the same number.
    started
        The same in words, UTC.
    """

    host: str
    pid: int
    born: float
    started: str

    @property
    def gone(self) -> bool:
        """Whether it certainly does not run any more; False for one on another machine."""
        if self.host != socket.gethostname():
            return False
        try:
            process = psutil.Process(self.pid)
            ended = process.status() == psutil.STATUS_ZOMBIE  # not yet fetched by its parent
            return ended or abs(process.create_time() - self.born) > 1.0
        except psutil.NoSuchProcess:
            return True

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}, started {self.started}"


def begin(folder: Path) -> None:
    """Record that this process runs Snakemake in `folder`."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    run = Run(socket.gethostname(), os.getpid(), psutil.Process().create_time(), now)
    with atomic_path(_record(folder, run.host, run.pid)) as temporary:
        temporary.write_text(json.dumps(asdict(run)))


def end(folder: Path) -> None:
    """Remove the record of this process."""
    _record(folder, socket.gethostname(), os.getpid()).unlink(missing_ok=True)


def _record(folder: Path, host: str, pid: int) -> Path:
    return folder / _RECORDS / f"{host}-{pid}.json"


def runs(folder: Path) -> list[Run]:
    """All records of `folder`, also of killed runs."""
    return [Run(**json.loads(path.read_text())) for path in sorted((folder / _RECORDS).glob("*.json"))]


def is_locked(folder: Path) -> bool:
    """Whether Snakemake would refuse to start in `folder`."""
    return any((folder / _LOCKS).glob("*"))


def check_abandoned(folder: Path) -> None:
    """Return if the owners of the lock of `folder` are certainly gone.

    Raises
    ------
    LockedError
        If one runs, runs on another machine, or left no record.
    """
    found = runs(folder)
    alive = [run for run in found if not run.gone]
    if alive:
        here = alive[0].host == socket.gethostname()
        raise LockedError(
            f"{folder.resolve()} is locked by {alive[0]}"
            + ("; wait for it, or stop it" if here else "; if it is gone, `snakemake --unlock` lifts the lock")
        )
    if not found:
        raise LockedError(
            f"{folder.resolve()} is locked, and it is not recorded by whom; if no Snakemake works in it, here or "
            "on another machine, `snakemake --unlock` lifts the lock"
        )


def forget_gone(folder: Path) -> None:
    """Remove the records of runs that are gone."""
    for run in runs(folder):
        if run.gone:
            _record(folder, run.host, run.pid).unlink(missing_ok=True)
