"""Memory of the inference: batches of bounded size, and the peak that is to be expected of a whole analysis.

Arrays of rows x rows, or of bootstrapped tables x rows in floating point, are never whole: functions that need
them work on as many rows at a time as `row_batches` says.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

BATCH_ELEMENTS = 4_000_000  # of a temporary array: 32 MB in float64. A table of 2,483 samples is mostly one batch.


def row_batches(n_rows: int, n_columns: int, largest: int | None = None) -> Iterator[slice]:
    """Divide the rows of an array [n_rows, n_columns] into batches of `BATCH_ELEMENTS`, `largest` rows at most."""
    size = max(1, BATCH_ELEMENTS // max(n_columns, 1))
    size = size if largest is None else min(size, largest)
    for start in range(0, n_rows, size):
        yield slice(start, min(start + size, n_rows))


def peak_mb(n_samples: int, n_numbers: int, n_bootstrap: int, n_trials: int) -> int:
    """Return the memory [MB] that the stages `abc` and `exclusion` need at most, rounded up to 100.

    Parameters
    ----------
    n_samples, n_numbers
        Samples of the table, and numbers in the summaries of each.
    n_bootstrap, n_trials
        Bootstrapped tables, and samples that play the observation.
    """
    # several copies of the summaries; counts of the bootstrapped tables and of the trials, a byte each
    bytes_per_sample = 6 * 8 * n_numbers + 2 * (n_bootstrap + n_trials)
    return 100 * math.ceil((400e6 + n_samples * bytes_per_sample) / 100e6)
