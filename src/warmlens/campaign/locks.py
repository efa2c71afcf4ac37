"""Who is at work in a folder: records of running Snakemakes, and whether their lock may be lifted.

Snakemake locks its working folder with files that say nothing of their owner, and a killed one leaves them behind.
Results that are reached from several working folders it does not lock at all; who works on them is recorded there.
"""

from __future__ import annotations

import json
import os
import socket
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import psutil

from warmlens.artifacts.file import atomic_path

_RECORDS = Path(".snakemake/warmlens-runs")
_LOCKS = Path(".snakemake/locks")
_CLAIMS = Path(".runs")  # in a results folder


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
    folder
        Its working folder.
    """

    host: str
    pid: int
    born: float
    started: str
    folder: str = ""

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


def begin(folder: Path, results: Path) -> None:
    """Record that this process runs Snakemake in `folder` and makes `results`.

    Raises
    ------
    LockedError
        If one of another working folder makes the same results, or may. Within a folder Snakemake sees to that.
    """
    now = datetime.now(UTC).isoformat(timespec="seconds")
    run = Run(socket.gethostname(), os.getpid(), psutil.Process().create_time(), now, str(folder.resolve()))
    for place in (folder / _RECORDS, results / _CLAIMS):
        with atomic_path(_record(place, run)) as temporary:
            temporary.write_text(json.dumps(asdict(run)))
    # only now, so that of two that begin at once none overlooks the other
    for other in _read(results / _CLAIMS):
        if other.folder != run.folder and not other.gone:
            end(folder, results)
            elsewhere = f"; if it is gone, delete {_record(results / _CLAIMS, other)}"
            raise LockedError(
                f"{results.resolve()}: {other}, works on these results from the folder {other.folder}; "
                f"wait for it, or stop it{'' if other.host == run.host else elsewhere}"
            )
    _forget_gone(results / _CLAIMS)


def end(folder: Path, results: Path) -> None:
    """Remove the records of this process."""
    for place in (folder / _RECORDS, results / _CLAIMS):
        (place / _name(socket.gethostname(), os.getpid())).unlink(missing_ok=True)


def _record(place: Path, run: Run) -> Path:
    return place / _name(run.host, run.pid)


def _name(host: str, pid: int) -> str:
    return f"{host}-{pid}.json"


def _read(place: Path) -> list[Run]:
    return [Run(**json.loads(path.read_text())) for path in sorted(place.glob("*.json"))]


def runs(folder: Path) -> list[Run]:
    """All records of `folder`, also of killed runs."""
    return _read(folder / _RECORDS)


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
    _forget_gone(folder / _RECORDS)


def _forget_gone(place: Path) -> None:
    for run in _read(place):
        if run.gone:
            _record(place, run).unlink(missing_ok=True)
