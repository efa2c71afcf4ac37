"""Who works in a folder: records of running Snakemakes, and whether their lock may be lifted.

Snakemake locks its working folder with files that do not name their owner, and a killed one leaves them behind.
It does not lock results that several working folders can reach; a record in the results says who works on them.
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
    """A Snakemake that began in the working folder `folder`.

    `born` is when its process began [s since the epoch], for a later process may have the same number; `started`
    is the same in words, UTC.
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
            ended = process.status() == psutil.STATUS_ZOMBIE  # not yet waited for by its parent
            return ended or abs(process.create_time() - self.born) > 1.0
        except psutil.NoSuchProcess:
            return True

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}, started {self.started}"


def begin(folder: Path, results: Path) -> None:
    """Record that this process runs Snakemake in `folder` and computes `results`.

    Raises
    ------
    LockedError
        If one of another working folder computes the same results, or may. Within a folder Snakemake sees to that.
    """
    now = datetime.now(UTC).isoformat(timespec="seconds")
    run = Run(socket.gethostname(), os.getpid(), psutil.Process().create_time(), now, str(folder.resolve()))
    for place in (folder / _RECORDS, results / _CLAIMS):
        with atomic_path(_file(place, run.host, run.pid)) as temporary:
            temporary.write_text(json.dumps(asdict(run)), encoding="utf-8")
    # only now, so that of two that begin at once none overlooks the other
    for other in runs(results, _CLAIMS):
        if other.folder != run.folder and not other.gone:
            end(folder, results)
            elsewhere = f"; if it is gone, delete {_file(results / _CLAIMS, other.host, other.pid)}"
            raise LockedError(
                f"{results.resolve()}: {other}, works on these results from the folder {other.folder}; "
                f"wait for it, or stop it{'' if other.host == run.host else elsewhere}"
            )
    forget_gone(results, _CLAIMS)


def end(folder: Path, results: Path) -> None:
    """Remove the records of this process."""
    for place in (folder / _RECORDS, results / _CLAIMS):
        _file(place, socket.gethostname(), os.getpid()).unlink(missing_ok=True)


def _file(place: Path, host: str, pid: int) -> Path:
    return place / f"{host}-{pid}.json"


def runs(folder: Path, place: Path = _RECORDS) -> list[Run]:
    """Read all records of `folder`, also those of killed runs."""
    return [
        Run(**json.loads(path.read_text(encoding="utf-8"))) for path in sorted((folder / place).glob("*.json"))
    ]


def forget_gone(folder: Path, place: Path = _RECORDS) -> None:
    """Remove the records of runs that are gone."""
    for run in runs(folder, place):
        if run.gone:
            _file(folder / place, run.host, run.pid).unlink(missing_ok=True)


def is_locked(folder: Path) -> bool:
    """Return whether Snakemake would refuse to start in `folder`."""
    return any((folder / _LOCKS).glob("*"))


def check_abandoned(folder: Path) -> None:
    """Return if the owners of the lock of `folder` are certainly gone.

    Raises
    ------
    LockedError
        If one runs, runs on another machine, or left no record.
    """
    recorded = runs(folder)
    alive = [run for run in recorded if not run.gone]
    if alive:
        here = alive[0].host == socket.gethostname()
        raise LockedError(
            f"{folder.resolve()} is locked by {alive[0]}"
            + ("; wait for it, or stop it" if here else "; if it is gone, `snakemake --unlock` lifts the lock")
        )
    if not recorded:
        raise LockedError(
            f"{folder.resolve()} is locked, and it is not recorded by whom; if no Snakemake works in it, here or "
            "on another machine, `snakemake --unlock` lifts the lock"
        )
