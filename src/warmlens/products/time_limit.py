"""A limit on the time of one sample: a sample that hangs fails, and does not hold up the campaign.

The limit is one of processor time. A suspended job and a laptop that sleeps use none, and on a machine with ten
jobs per core a sample uses no more than on an idle one.
"""

from __future__ import annotations

import contextlib
import faulthandler
import math
import signal
import time
from collections.abc import Callable, Iterator
from types import FrameType

SAMPLE_SECONDS = 600  # a sample takes a second at most
GRACE = 2.0  # a job that is still in the same sample after so many limits is ended
MAX_IDLE = 3  # limits of wall time one after the other without computing, after which a job is ended
_IDLE_SHARE = 0.01  # of a core, below which a job does not compute


class SampleTimeError(RuntimeError):
    """A sample took too long. It is no TimeoutError: that is an OSError, an error of the machine."""


@contextlib.contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise `SampleTimeError` in the block after `seconds` of processor time; end the process after twice that.

    Python code is interrupted by a signal. A compiled kernel does not return to Python, so that no exception can
    be raised in it: then a signal handler that needs no Python writes the traceback to stderr, and the signal ends
    the process.

    Waiting without computing is no fault of a sample: after `MAX_IDLE` times `seconds` of wall time it raises
    TimeoutError. However long a process is suspended, it counts once: the signals of a timer do not add up.

    Parameters
    ----------
    seconds
        Infinity for no limit.

    Raises
    ------
    ValueError
        If the limit is not positive, or outside the main thread, where Python hands over no signals.
    """
    if not seconds > 0.0:
        raise ValueError(
            f"sample_seconds = {seconds:g}, expected > 0; see --set-resources RULE:sample_seconds=600"
        )
    if math.isinf(seconds):
        yield
        return
    used, idle = time.process_time(), 0

    def expired(_number: int, _frame: FrameType | None) -> None:
        raise SampleTimeError(
            f"not done after {seconds:g} s of processor time; if such a sample only needs longer, raise the limit "
            "(--set-resources RULE:sample_seconds=SECONDS), delete the artifact and start the campaign again"
        )

    def look(_number: int, _frame: FrameType | None) -> None:
        nonlocal used, idle
        before, used = used, time.process_time()
        idle = idle + 1 if used - before < _IDLE_SHARE * seconds else 0
        if idle == MAX_IDLE:
            raise TimeoutError(
                f"waited for {idle * seconds:g} s without computing, as for a disk that does not answer; "
                "start the campaign again"
            )

    with _handled(signal.SIGPROF, expired), _handled(signal.SIGALRM, look), _fatal(signal.SIGVTALRM):
        try:
            signal.setitimer(signal.ITIMER_VIRTUAL, GRACE * seconds)  # processor time outside the kernel
            signal.setitimer(signal.ITIMER_PROF, seconds)  # processor time
            signal.setitimer(signal.ITIMER_REAL, seconds, seconds)  # wall time, again and again
            yield
        finally:
            for timer in (signal.ITIMER_REAL, signal.ITIMER_PROF, signal.ITIMER_VIRTUAL):
                signal.setitimer(timer, 0.0)  # a signal may still come before this, but only once


@contextlib.contextmanager
def _handled(number: signal.Signals, handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)


@contextlib.contextmanager
def _fatal(number: signal.Signals) -> Iterator[None]:
    """Let a signal write the traceback and end the process, whether or not Python can run."""
    with _handled(number, signal.SIG_DFL):  # type: ignore[arg-type]  # the action of which is to end the process
        faulthandler.register(number, all_threads=False, chain=True)
        try:
            yield
        finally:
            faulthandler.unregister(number)
