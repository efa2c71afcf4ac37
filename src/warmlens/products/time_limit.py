"""A limit on the time of one sample: a sample that hangs fails, and does not hold up the campaign."""

from __future__ import annotations

import contextlib
import faulthandler
import math
import signal
from collections.abc import Iterator
from types import FrameType

SAMPLE_SECONDS = 600  # a sample takes a second at most
GRACE = 2.0  # a job that is still in the same sample after so many limits is ended


class SampleTimeError(RuntimeError):
    """A sample took too long. It is no TimeoutError: that is an OSError, an error of the machine."""


@contextlib.contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise `SampleTimeError` in the block after `seconds`; end the process after twice that.

    Python code is interrupted by an alarm. A compiled kernel does not return to Python, so that no exception can
    be raised in it: then a watchdog, which needs no Python, writes the traceback to stderr and ends the process.

    Parameters
    ----------
    seconds
        Wall time; infinity for no limit.

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

    def expired(_number: int, _frame: FrameType | None) -> None:
        raise SampleTimeError(
            f"not done after {seconds:g} s; if such a sample only needs longer, raise the limit "
            "(--set-resources RULE:sample_seconds=SECONDS), delete the artifact and start the campaign again"
        )

    before = signal.signal(signal.SIGALRM, expired)
    faulthandler.dump_traceback_later(GRACE * seconds, exit=True)
    try:
        signal.setitimer(signal.ITIMER_REAL, seconds)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)  # the alarm may still go off before this, but only once
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.signal(signal.SIGALRM, before)
