"""Whether a lock may be lifted: only if all who may hold it are certainly gone."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import fcntl
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from warmlens.campaign import locks
from warmlens.campaign.locks import LockedError, Run

from ..reliability import Outcome, fault


def record(folder: Path, run: Run) -> None:
    target = folder / ".snakemake/warmlens-runs" / f"{run.host}-{run.pid}.json"
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(json.dumps(run.__dict__))


@pytest.fixture
def locked(tmp_path: Path) -> Path:
    (tmp_path / ".snakemake/locks").mkdir(parents=True)
    (tmp_path / ".snakemake/locks/0.output.lock").write_text("results/abc.h5\n")
    assert locks.is_locked(tmp_path)
    return tmp_path


def dead() -> Run:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return Run(socket.gethostname(), process.pid, 1.0, "2026-01-01T00:00:00+00:00")


def test_no_lock_without_files(tmp_path: Path) -> None:
    assert not locks.is_locked(tmp_path)
    (tmp_path / ".snakemake/locks").mkdir(parents=True)
    assert not locks.is_locked(tmp_path)


def test_begin_and_end(tmp_path: Path) -> None:
    locks.begin(tmp_path, tmp_path / "results")
    ((path, run),) = locks.runs(tmp_path).items()
    assert run.pid == os.getpid() and run.flock and locks.is_gone(path, run) is False
    locks.forget_gone(tmp_path)
    assert locks.runs(tmp_path) == {path: run}
    locks.end(tmp_path, tmp_path / "results")
    assert locks.runs(tmp_path) == {}


def test_lock_of_a_killed_run_is_abandoned(locked: Path) -> None:
    record(locked, dead())
    locks.check_abandoned(locked)
    locks.forget_gone(locked)
    assert locks.runs(locked) == {}


def test_killed_run_that_nobody_has_waited_for(locked: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    born = psutil.Process(process.pid).create_time()
    record(locked, Run(socket.gethostname(), process.pid, born, "then"))
    with pytest.raises(LockedError):
        locks.check_abandoned(locked)
    process.kill()
    while psutil.Process(process.pid).status() != psutil.STATUS_ZOMBIE:
        pass
    locks.check_abandoned(locked)
    process.wait()


def test_number_of_a_dead_process_given_to_another(locked: Path) -> None:
    """The number lives, but its process began later than the record says."""
    born = psutil.Process().create_time()
    record(locked, Run(socket.gethostname(), os.getpid(), born - 100.0, "then"))
    locks.check_abandoned(locked)


def test_lock_of_a_running_one_is_kept(locked: Path) -> None:
    record(locked, dead())
    locks.begin(locked, locked / "results")
    with pytest.raises(LockedError, match=rf"is locked by process {os.getpid()} on .*wait for it"):
        locks.check_abandoned(locked)


def test_lock_from_another_machine_is_kept(locked: Path) -> None:
    record(locked, Run("another-machine", 1, 1.0, "2026-01-01T00:00:00+00:00"))
    with pytest.raises(
        LockedError, match=r"on another-machine, started 2026.*delete .*-1.json and call `snakemake --unlock`"
    ):
        locks.check_abandoned(locked)


def test_lock_without_a_record_is_kept(locked: Path) -> None:
    with pytest.raises(LockedError, match=r"not recorded by whom.*`snakemake --unlock` lifts the lock"):
        locks.check_abandoned(locked)


class TestResultsOfSeveralFolders:
    """Snakemake locks its working folder; results may be reached from another one."""

    def other(self, results: Path, folder: Path, host: str = "") -> subprocess.Popen[bytes]:
        process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
        born = psutil.Process(process.pid).create_time()
        run = Run(host or socket.gethostname(), process.pid, born, "then", str(folder))
        target = results / ".runs" / f"{run.host}-{run.pid}.json"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(json.dumps(run.__dict__))
        return process

    def test_one_that_works_from_another_folder(self, tmp_path: Path) -> None:
        results = tmp_path / "results"
        process = self.other(results, tmp_path / "there")
        with pytest.raises(LockedError, match=rf"process {process.pid} .* from the folder .*there; wait for it"):
            locks.begin(tmp_path, results)
        assert len(list(results.glob(".runs/*"))) == 1, "a run that was refused leaves no record"
        assert locks.runs(tmp_path) == {}
        process.kill()
        process.wait()
        locks.begin(tmp_path, results)
        (left,) = results.glob(".runs/*")
        assert left.name.endswith(f"-{os.getpid()}.json"), "the record of a killed run is removed"
        locks.end(tmp_path, results)
        assert not list(results.glob(".runs/*"))

    def test_one_of_the_same_folder_is_left_to_the_lock(self, tmp_path: Path) -> None:
        process = self.other(tmp_path / "results", tmp_path)
        (claim,) = (tmp_path / "results/.runs").glob("*")
        (tmp_path / ".snakemake/warmlens-runs").mkdir(parents=True)
        shutil.copy(claim, tmp_path / ".snakemake/warmlens-runs")
        locks.begin(tmp_path, tmp_path / "results")
        process.kill()
        process.wait()

    def test_one_on_another_machine(self, tmp_path: Path) -> None:
        results = tmp_path / "results"
        self.other(results, tmp_path / "there", "another-machine").kill()
        with pytest.raises(LockedError, match="if it is gone, delete ") as error:
            locks.begin(tmp_path, results)
        Path(str(error.value).rpartition("delete ")[2]).unlink()
        locks.begin(tmp_path, results)


HOLD = """
import sys, time
from pathlib import Path
from warmlens.campaign import locks
locks.begin(Path(sys.argv[1]), Path(sys.argv[2]))
print("up", flush=True)
time.sleep(60)
"""


@contextlib.contextmanager
def holding(folder: Path, *before: str) -> Iterator[subprocess.Popen[str]]:
    """A process that works in `folder`, as soon as its record is there; `before` is what it is started with."""
    folder.mkdir(parents=True, exist_ok=True)
    command = [*before, sys.executable, "-c", HOLD, str(folder), str(folder / "results")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as process:
        assert process.stdout is not None
        if process.stdout.readline() != "up\n":
            process.wait()
            pytest.skip(f"{' '.join(before)}: needs root that may")
        yield process
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


@fault("Processes", "a second Snakemake in another container", "`unshare --pid`, the same host name", quick=True)
def test_a_run_in_another_namespace_of_processes(locked: Path, outcome: Outcome) -> None:
    """Its number means nothing here, or is that of another process."""
    if shutil.which("unshare") is None:
        pytest.skip("needs unshare")
    with holding(locked, "unshare", "--pid", "--fork", "--mount-proc", "--kill-child") as process:
        ((path, run),) = locks.runs(locked).items()
        assert run.pid == 1 and run.namespace != locks._namespace()
        assert run.host == socket.gethostname()
        for record in (locked / ".snakemake/warmlens-runs").glob("*"):
            assert json.loads(record.read_text())["flock"]
        with pytest.raises(LockedError) as error:
            locks.check_abandoned(locked)
        outcome.stops(str(error.value), "is locked by process 1 on", "wait for it, or stop it")
        with pytest.raises(LockedError, match="works on these results from the folder"):
            locks.begin(locked.parent / "elsewhere", locked / "results")
        locks.forget_gone(locked)
        assert list(locks.runs(locked)) == [path]
        process.kill()
        process.wait()
        while locks.is_gone(path, run) is False:
            time.sleep(0.01)
    locks.check_abandoned(locked)
    locks.begin(locked.parent / "elsewhere", locked / "results")
    locks.end(locked.parent / "elsewhere", locked / "results")


def test_a_killed_run_lets_its_lock_go(locked: Path) -> None:
    with holding(locked) as process:
        with pytest.raises(LockedError, match=f"is locked by process {process.pid}"):
            locks.check_abandoned(locked)
        process.kill()
        process.wait()
        locks.check_abandoned(locked)


def recorded(path: Path, **values: Any) -> Run:
    run = dataclasses.replace(locks._this_run(path.parent), **values)
    path.write_text(json.dumps(dataclasses.asdict(run)))
    return run


@pytest.mark.parametrize(
    ("values", "gone"),
    [
        ({"flock": True}, True),  # nobody holds it, though this process has the number
        ({"flock": True, "namespace": "pid:[7]"}, True),
        ({"flock": True, "host": "another"}, True),  # a container's name: the kernel is the same
        ({"flock": False}, False),  # a file system without flock: the process lives
        ({"flock": False, "born": 1.0}, True),
        ({"flock": False, "namespace": "pid:[7]"}, None),
        ({"flock": False, "host": "another"}, False),
        ({"boot": "before"}, True),  # the machine was started anew
        ({"boot": "before", "flock": True}, True),
        ({"boot": "before", "namespace": "pid:[7]"}, None),
        ({"boot": "before", "host": "another"}, None),
        ({"boot": "", "namespace": ""}, False),  # a record of an early version
        ({"boot": "", "namespace": "", "born": 1.0}, True),
        ({"boot": "", "namespace": "", "host": "another"}, None),
    ],
)
def test_who_is_gone(
    tmp_path: Path, values: dict[str, Any], gone: bool | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not locks._boot():
        pytest.skip("needs the boot id of Linux")
    monkeypatch.setattr(locks, "_namespace", lambda: locks._INITIAL)
    path = tmp_path / "record.json"
    assert locks.is_gone(path, recorded(path, **values)) is gone


def test_in_a_container_a_restart_of_the_machine_is_not_certain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(locks, "_namespace", lambda: "pid:[7]")
    path = tmp_path / "record.json"
    assert locks.is_gone(path, recorded(path, boot="before")) is None


def test_a_file_system_that_cannot_lock(locked: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def flock(handle: Any, operation: int) -> None:
        raise OSError(errno.ENOLCK, "no locks available")

    monkeypatch.setattr(fcntl, "flock", flock)
    locks.begin(locked, locked / "results")
    ((path, run),) = locks.runs(locked).items()
    assert not run.flock and locks.is_gone(path, run) is False
    locks.end(locked, locked / "results")


@fault("Processes", "the record of a run is empty or damaged", "as a loss of power leaves it", quick=True)
@pytest.mark.parametrize("content", ["", "{", "[]", "null", '{"host": "here"}', '{"host": 1}', "\0" * 50])
def test_a_damaged_record_is_named_and_removed(
    locked: Path, content: str, outcome: Outcome, capsys: pytest.CaptureFixture[str]
) -> None:
    path = locked / f".snakemake/warmlens-runs/{socket.gethostname()}-17.json"
    path.parent.mkdir(parents=True)
    path.write_text(content)
    locks.check_abandoned(locked)
    assert not path.exists()
    assert f"{path}: not a readable record of a run" in capsys.readouterr().out
    locks.begin(locked, locked / "results")
    locks.end(locked, locked / "results")
    outcome.goes_on("the record is named and removed, and the campaign goes on", "nothing")


def test_a_damaged_record_of_another_machine_is_left(locked: Path) -> None:
    path = locked / ".snakemake/warmlens-runs/another-17.json"
    path.parent.mkdir(parents=True)
    path.write_text("")
    with pytest.raises(LockedError, match=r"another-17.json: not a readable record .* delete the file"):
        locks.check_abandoned(locked)
    assert path.exists()
