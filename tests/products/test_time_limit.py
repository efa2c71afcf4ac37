"""One sample that hangs fails alone; one that hangs in a kernel ends its job, which names it."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from warmlens.products.samples import FAILED_HERE, OK, SampleTable
from warmlens.products.time_limit import SampleTimeError, time_limit
from warmlens.sampling import draw_parameters

from ..reliability import Outcome, fault

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
    assert "not done after 0.3 s" in table.message[2] and "--set-resources RULE:sample_seconds" in table.message[2]
    assert "in work" in table.trace[2]
    assert signal.getsignal(signal.SIGALRM) is before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    outcome.goes_on("the sample fails, the others go on", "that sample, counted as failed")


@fault("Samples", "a sample takes forever in compiled code", "an endless loop in a kernel", quick=True)
def test_a_kernel_that_hangs_ends_the_job(tmp_path: Path, outcome: Outcome) -> None:
    (tmp_path / "job.py").write_text(IN_A_KERNEL)
    done = subprocess.run(
        [sys.executable, str(tmp_path / "job.py")], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 1
    assert done.stderr.rindex("halos: sample 12") > done.stderr.rindex("halos: sample 11")
    assert "halos: sample 13" not in done.stderr
    outcome.stops(done.stderr, "Timeout (0:00:01)!", "halos: sample 12", "in for_each", lost="that job")


def test_what_ends_in_time_is_left_alone() -> None:
    with time_limit(0.2):
        pass
    with time_limit(math.inf):
        time.sleep(0.5)  # the first limit is over


def test_a_limit_within_which_something_else_fails() -> None:
    with pytest.raises(KeyError), time_limit(60.0):
        raise KeyError("x")
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    with pytest.raises(SampleTimeError), time_limit(0.1):
        time.sleep(5.0)


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
