"""Whether a lock may be lifted: only if all who may hold it are certainly gone."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from warmlens.campaign import locks
from warmlens.campaign.locks import LockedError, Run


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
    (run,) = locks.runs(tmp_path)
    assert run.pid == os.getpid() and not run.gone
    locks.forget_gone(tmp_path)
    assert locks.runs(tmp_path) == [run]
    locks.end(tmp_path, tmp_path / "results")
    assert locks.runs(tmp_path) == []


def test_lock_of_a_killed_run_is_abandoned(locked: Path) -> None:
    record(locked, dead())
    locks.check_abandoned(locked)
    locks.forget_gone(locked)
    assert locks.runs(locked) == []


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
        LockedError, match=r"on another-machine, started 2026.*if it is gone, `snakemake --unlock`"
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
        assert locks.runs(tmp_path) == []
        process.kill()
        process.wait()
        locks.begin(tmp_path, results)
        (left,) = results.glob(".runs/*")
        assert left.name.endswith(f"-{os.getpid()}.json"), "the record of a killed run is removed"
        locks.end(tmp_path, results)
        assert not list(results.glob(".runs/*"))

    def test_one_of_the_same_folder_is_left_to_the_lock(self, tmp_path: Path) -> None:
        process = self.other(tmp_path / "results", tmp_path)
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
