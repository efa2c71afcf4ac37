"""Who works in a folder: records of running Snakemakes, and whether their lock may be lifted.

Snakemake locks its working folder with files that do not name their owner, and a killed one leaves them behind.
It does not lock results that several working folders can reach; a record in the results says who works on them.

A running Snakemake holds its records open under `flock`. On one machine this shows whether it runs, also where
its process cannot be seen: two containers number their processes each for itself, and may share a host name.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import socket
import uuid
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

import psutil

from warmlens.artifacts.atomic import atomic_path

_RECORDS = Path(".snakemake/warmlens-runs")
_LOCKS = Path(".snakemake/locks")
_CLAIMS = Path(".runs")  # in a results folder
_INITIAL = "pid:[4026531836]"  # namespace of the processes of a whole machine, the same number on every Linux
_WAIT = "wait for it, or stop it"

_held: dict[Path, IO[str]] = {}  # records of this process, locked while they are open


class LockedError(RuntimeError):
    """The working folder is locked, and it is not certain that its owner is gone."""


@dataclass(frozen=True)
class Run:
    """A Snakemake that began in the working folder `folder`.

    `born` is when its process began [s since the epoch], for a later process may have the same number; `started`
    is the same in words, UTC. `boot` names the run of the machine's kernel and `namespace` where `pid` counts:
    empty in records of early versions, and where the system does not have them. `flock` is whether the file system
    could lock the record.
    """

    host: str
    pid: int
    born: float
    started: str
    folder: str = ""
    boot: str = ""
    namespace: str = ""
    flock: bool = False

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}, started {self.started}"


_EXAMPLE = Run("host", 1, 0.0, "then")  # of the types


def _this_run(folder: Path) -> Run:
    now = datetime.now(UTC).isoformat(timespec="seconds")
    born = psutil.Process().create_time()
    return Run(socket.gethostname(), os.getpid(), born, now, str(folder.resolve()), _boot(), _namespace())


def _boot() -> str:
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="utf-8").strip()
    except OSError:
        return ""


def _namespace() -> str:
    try:
        return str(Path("/proc/self/ns/pid").readlink())
    except OSError:
        return ""


def is_gone(path: Path, run: Run) -> bool | None:
    """Return whether the run of the record `path` has ended; None if that is not certain."""
    here = run.host == socket.gethostname()
    if run.boot and run.boot == _boot():
        if run.flock and (locked := _is_flocked(path)) is not None:
            return not locked
        return _has_ended(run) if run.namespace == _namespace() else None
    if run.boot:
        rebooted = here and run.namespace == _namespace() == _INITIAL
        return True if rebooted else None
    return _has_ended(run) if here else None


def _is_flocked(path: Path) -> bool | None:
    """Return whether some process holds a record; None if the file system does not say."""
    try:
        with path.open(encoding="utf-8") as handle:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:
        return False
    except OSError:
        return None
    return False


def _has_ended(run: Run) -> bool:
    """Return whether there is no such process among those that this one can see."""
    try:
        process = psutil.Process(run.pid)
        ended = process.status() == psutil.STATUS_ZOMBIE  # not yet waited for by its parent
        return ended or abs(process.create_time() - run.born) > 1.0
    except psutil.NoSuchProcess:
        return True


def begin(folder: Path, results: Path) -> None:
    """Record that this process runs Snakemake in `folder` and computes `results`.

    Raises
    ------
    LockedError
        If one of another working folder computes the same results, or may. Within a folder Snakemake sees to that.
    """
    run = _this_run(folder)
    name = f"{run.host}-{uuid.uuid4().hex[:8]}-{run.pid}.json"  # of two containers both may be equal
    for place in (folder / _RECORDS, results / _CLAIMS):
        _hold(place / name, run)
    # only now, so that of two that begin at once none overlooks the other
    for path, other in runs(results, _CLAIMS).items():
        same_folder = (folder / _RECORDS / path.name).exists()
        if not same_folder and not (gone := is_gone(path, other)):
            end(folder, results)
            raise LockedError(
                f"{results.resolve()}: {other}, works on these results from the folder {other.folder}; {_WAIT}"
                + (f"; if it is gone, delete {path}" if gone is None else "")
            )
    forget_gone(results, _CLAIMS)


def _hold(path: Path, run: Run) -> None:
    """Write a record, and keep it locked until this process ends."""
    with atomic_path(path) as temporary:
        handle = temporary.open("w", encoding="utf-8")
        with contextlib.suppress(OSError):  # not supported here
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        json.dump(asdict(run) | {"flock": _is_flocked(temporary) is True}, handle)
        handle.flush()
    _held[path] = handle


def end(folder: Path, results: Path) -> None:
    """Remove the records of this process."""
    for path in [path for path in _held if path.parent in (folder / _RECORDS, results / _CLAIMS)]:
        path.unlink(missing_ok=True)
        _held.pop(path).close()


def runs(folder: Path, place: Path = _RECORDS) -> dict[Path, Run]:
    """Read all records of `folder`, also those of killed runs; damaged ones are named and removed.

    Raises
    ------
    LockedError
        If a damaged record may be that of a run on another machine.
    """
    recorded = {}
    for path in sorted((folder / place).glob("*.json")):
        try:
            recorded[path] = _parse(path.read_text(encoding="utf-8"))
        except FileNotFoundError:  # it has just ended
            continue
        except (OSError, ValueError, TypeError) as error:
            _remove_damaged(path, error)
    return recorded


def _parse(text: str) -> Run:
    raw = json.loads(text)
    if not isinstance(raw, dict):
        raise ValueError(f"expected a JSON object, found {type(raw).__name__}")
    run = Run(**{each.name: raw[each.name] for each in fields(Run) if each.name in raw})
    for name, value in asdict(run).items():
        if type(value) is not type(getattr(_EXAMPLE, name)) and not (name == "born" and type(value) is int):
            raise ValueError(f"{name} is {value!r}")
    return run


def _remove_damaged(path: Path, error: Exception) -> None:
    """Remove a record that a loss of power has damaged, unless a process holds it or another machine wrote it."""
    if _is_flocked(path) or not path.name.startswith(f"{socket.gethostname()}-"):
        raise LockedError(
            f"{path}: not a readable record of a run ({error}), and it is not certain that the run is gone; if it "
            "is, delete the file"
        )
    print(f"{path}: not a readable record of a run ({error}); removed", flush=True)
    path.unlink(missing_ok=True)


def forget_gone(folder: Path, place: Path = _RECORDS) -> None:
    """Remove the records of runs that are gone."""
    for path, run in runs(folder, place).items():
        if is_gone(path, run):
            path.unlink(missing_ok=True)


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
    was_recorded = any((folder / _RECORDS).glob("*.json"))  # damaged records are removed when they are read
    for path, run in runs(folder).items():
        if not (gone := is_gone(path, run)):
            raise LockedError(
                f"{folder.resolve()} is locked by {run}; "
                + (f"if it is gone, delete {path} and call `snakemake --unlock`" if gone is None else _WAIT)
            )
    if not was_recorded:
        raise LockedError(
            f"{folder.resolve()} is locked, and it is not recorded by whom; if no Snakemake works in it, here or "
            "on another machine, `snakemake --unlock` lifts the lock"
        )
