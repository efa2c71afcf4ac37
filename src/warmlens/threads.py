"""One thread a job: parallelism is over jobs, and results do not depend on the number of cores."""

from __future__ import annotations

import os

_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def use_one_thread() -> None:
    """Limit the numerical libraries to one thread, here (if called before they are imported) and in children.

    Variables that the user has set are left alone.
    """
    for variable in _VARIABLES:
        os.environ.setdefault(variable, "1")
