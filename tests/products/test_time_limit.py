"""One sample that hangs fails alone, in a kernel it ends its job; a suspended job loses nothing."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from warmlens.products.samples import FAILED_HERE, OK, SampleTable
from warmlens.products.time_limit import time_limit
from warmlens.sampling import draw_parameters

from ..reliability import Outcome, fault

TIMERS = (signal.ITIMER_REAL, signal.ITIMER_PROF, signal.ITIMER_VIRTUAL)
IN_A_KERNEL = """\
import logging
from numba import njit
from warmlens.sampling import draw_parameters
from warmlens.products.samples import SampleTable

@njit
def endless(n: int) -> int:
    while n > 0:
        n += n & 1
    return n

endless(0)  # compiled
logging.basicConfig(level=logging.INFO)
table = SampleTable(draw_parameters(1, (10, 15), (1.0, 5.0), (13.0, 13.5)))
table.for_each(lambda row: endless(2 * (row == 2)), "halos", 0.5)
"""

# Three samples of some 0.2 s each, in Python and in a kernel; the limit is 0.6 s.
SUSPENDED = """\
import logging, sys
from pathlib import Path
import numpy as np
from numba import njit
from warmlens.artifacts.file import Dataset
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.sampling import draw_parameters
from warmlens.products.samples import SampleTable

@njit
def spin(n: int) -> int:
    x = 1
    for _ in range(n):
        x = (x * 48271) % 2147483647
    return x

spin(0)  # compiled
logging.basicConfig(level=logging.INFO)
table, numbers = SampleTable(draw_parameters(1, (10, 13), (1.0, 5.0), (13.0, 13.5))), np.zeros(3, dtype=np.int64)

def work(row: int) -> None:
    numbers[row] = spin.py_func(2_000_000) if row == 1 else spin(60_000_000)

table.for_each(work, "halos", 0.6)
datasets = {**table.datasets(), "numbers": Dataset(numbers, "", ("sample",), "")}
print(write_artifact(Path(sys.argv[1]), Provenance("halos", {}), datasets, {}))
"""


@fault("Samples", "a sample takes forever", "an endless loop in Python code of a stage", quick=True)
def test_only_the_sample_that_hangs_fails(outcome: Outcome) -> None:
    before = signal.getsignal(signal.SIGALRM)
    table, seen = SampleTable(draw_parameters(1, (10, 15), (1.0, 5.0), (13.0, 13.5))), []

    def work(row: int) -> None:
        while row == 2:
            pass
        seen.append(row)

    table.for_each(work, "halos", 0.3)
    assert seen == [0, 1, 3, 4]
    assert table.status.tolist() == [OK, OK, FAILED_HERE, OK, OK]
    assert "0.3 s of processor time" in table.message[2] and "RULE:sample_seconds" in table.message[2]
    assert "in work" in table.trace[2]
    assert signal.getsignal(signal.SIGALRM) is before
    assert all(signal.getitimer(timer) == (0.0, 0.0) for timer in TIMERS)
    outcome.goes_on("the sample fails, the others go on", "that sample, counted as failed")


@fault("Samples", "a sample takes forever in compiled code", "an endless loop in a kernel", quick=True)
def test_a_kernel_that_hangs_ends_the_job(tmp_path: Path, outcome: Outcome) -> None:
    (tmp_path / "job.py").write_text(IN_A_KERNEL)
    done = subprocess.run(
        [sys.executable, str(tmp_path / "job.py")], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == -signal.SIGVTALRM
    assert done.stderr.rindex("halos: sample 12") > done.stderr.rindex("halos: sample 11")
    assert "halos: sample 13" not in done.stderr
    outcome.stops(done.stderr, "halos: sample 12, at most 0.5 s of processor time", "in for_each", lost="that job")


@fault("Samples", "a job is suspended", "SIGSTOP for longer than all limits, then SIGCONT", quick=True)
def test_a_suspended_job_loses_nothing(tmp_path: Path, outcome: Outcome) -> None:
    """Stopped in a kernel and in Python, for longer than the limit, the watchdog's and that of waiting."""
    (tmp_path / "job.py").write_text(SUSPENDED)
    started = [
        subprocess.Popen(
            [sys.executable, str(tmp_path / "job.py"), str(tmp_path / f"{name}.h5")],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for name in ("undisturbed", "suspended")
    ]
    job = started[1]
    assert job.stderr is not None
    for sample in (10, 11):
        while f"halos: sample {sample}," not in (line := job.stderr.readline()):
            assert line, "the job ended"
        time.sleep(0.05)  # it is at work, for 0.2 s
        job.send_signal(signal.SIGSTOP)
        time.sleep(2.0)  # the limits are 0.6, 1.2 and 1.8 s
        job.send_signal(signal.SIGCONT)
    digests = [process.communicate(timeout=60)[0] for process in started]
    assert [process.returncode for process in started] == [0, 0]
    outcome.same_digests({"halos": digests[1]}, {"halos": digests[0]})


@fault("Samples", "a sample waits for the disk", "it reads a pipe that nobody writes", quick=True)
def test_a_sample_that_waits_is_not_the_sample_s_fault(tmp_path: Path, outcome: Outcome) -> None:
    os.mkfifo(tmp_path / "pipe")
    table = SampleTable(draw_parameters(1, (10, 12), (1.0, 5.0), (13.0, 13.5)))
    with pytest.raises(TimeoutError) as stopped:
        table.for_each(lambda _: (tmp_path / "pipe").read_text() and None, "halos", 0.1)
    assert table.status.tolist() == [OK, OK]
    assert all(signal.getitimer(timer) == (0.0, 0.0) for timer in TIMERS)
    said = str(stopped.value)
    outcome.stops(said, "waited for 0.3 s without computing", "start the campaign again", lost="that job")


def test_a_sample_on_a_busy_machine_has_its_time() -> None:
    """With a twentieth of a core it takes five times the limit, and three times that of waiting."""
    start, wall = time.process_time(), time.monotonic()
    with time_limit(0.2):
        while time.process_time() - start < 0.05 or time.monotonic() - wall < 1.0:
            busy = time.process_time() + 0.001
            while time.process_time() < busy:
                pass
            time.sleep(0.02)


def test_what_ends_in_time_is_left_alone() -> None:
    with time_limit(0.2):
        pass
    with time_limit(math.inf):
        time.sleep(0.5)  # the first limit is over


def test_a_limit_within_which_something_else_fails() -> None:
    with pytest.raises(KeyError), time_limit(60.0):
        raise KeyError("x")
    assert all(signal.getitimer(timer) == (0.0, 0.0) for timer in TIMERS)


def test_limits_that_cannot_be_kept() -> None:
    with pytest.raises(ValueError, match="sample_seconds = 0, expected > 0"), time_limit(0.0):
        pass
    errors = []

    def elsewhere() -> None:
        try:
            with time_limit(1.0):
                pass
        except ValueError as error:
            errors.append(str(error))

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert "main thread" in errors[0]
