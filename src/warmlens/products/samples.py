"""The table of samples that every chunk artifact carries, and work sample by sample with recorded failures."""

from __future__ import annotations

import logging
import math
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Artifact, Dataset
from warmlens.products.time_limit import time_limit
from warmlens.sampling import Parameters
from warmlens.types import BoolArray

log = logging.getLogger(__name__)

OK, FAILED_HERE, FAILED_UPSTREAM = 0, 1, 2
_REPORT_SECONDS = 10.0
_PARAMETERS = ("sample_id", "m_th_kev", "log10_m_halo_msun")


@dataclass
class SampleTable:
    """Parameters and fate of the samples of a chunk: 0 done, 1 failed here, 2 failed in an earlier stage."""

    parameters: Parameters
    status: np.ndarray = field(init=False)
    message: list[str] = field(init=False)
    trace: list[str] = field(init=False)

    def __post_init__(self) -> None:
        n = len(self.parameters.sample_id)
        self.status = np.zeros(n, dtype=np.uint8)
        self.message = [""] * n
        self.trace = [""] * n

    def __len__(self) -> int:
        return len(self.status)

    @property
    def done(self) -> BoolArray:
        """Rows that have not failed."""
        return self.status == OK

    def datasets(self) -> dict[str, Dataset]:
        """Return the table as datasets of an artifact."""
        p, axes = self.parameters, ("sample",)
        return {
            "samples/sample_id": Dataset(p.sample_id, "", axes, "number of the sample"),
            "samples/m_th_kev": Dataset(p.m_th_kev, "keV", axes, "thermal relic mass"),
            "samples/log10_m_halo_msun": Dataset(
                p.log10_m_halo_msun, "dex(Msun)", axes, "log10 of M200c of the host halo at the lens redshift"
            ),
            "samples/status": Dataset(
                self.status, "", axes, "0 done, 1 failed in this stage, 2 failed in an earlier stage"
            ),
            "samples/message": Dataset(self.message, "", axes, "why the sample failed"),
            "samples/traceback": Dataset(self.trace, "", axes, "where the sample failed"),
        }

    @classmethod
    def read(cls, artifact: Artifact) -> SampleTable:
        """Read the table of an earlier stage; its failures become `FAILED_UPSTREAM`."""
        numbers = [artifact.array(f"samples/{name}") for name in (*_PARAMETERS, "status")]
        texts = [artifact.strings(f"samples/{name}") for name in ("message", "traceback")]
        shapes = {array.shape for array in numbers} | {(len(text),) for text in texts}
        if len(shapes) != 1 or len(numbers[0].shape) != 1:
            raise ArtifactError(
                f"{artifact.path}: its table of samples has columns of different shapes {sorted(shapes)}; "
                "delete the file and run the campaign again"
            )
        table = cls(Parameters(*numbers[:-1]))
        table.status[numbers[-1] != OK] = FAILED_UPSTREAM
        table.message, table.trace = texts
        return table

    @classmethod
    def without_substructure(cls, n: int) -> SampleTable:
        """Return the table of n mocks of the null test, which have no relic mass and no halo."""
        nothing = np.full(n, np.nan)
        return cls(Parameters(np.arange(n), nothing, nothing))

    def for_each(self, work: Callable[[int], None], label: str, sample_seconds: float = math.inf) -> None:
        """Call `work(row)` for every row that has not failed; record a failure and go on.

        A sample that takes longer than `sample_seconds` of processor time fails, and is not tried again: it would
        take as long. Errors of the machine (OSError, MemoryError), waiting without computing among them, and
        damaged inputs are not the sample's and end the job, as does a chunk of which no sample is left.
        """
        rows = np.flatnonzero(self.done)
        start = last = time.monotonic()
        for count, row in enumerate(rows, start=1):
            if math.isfinite(sample_seconds):  # a sample that hangs in a kernel cannot log later
                sample = self.parameters.sample_id[row]
                log.info("%s: sample %d, at most %g s of processor time", label, sample, sample_seconds)
            try:
                with time_limit(sample_seconds):
                    work(int(row))
            except (OSError, MemoryError, ArtifactError):
                raise
            except Exception as error:
                self.status[row] = FAILED_HERE
                self.message[row] = f"{label}: {type(error).__name__}: {error}"
                self.trace[row] = traceback.format_exc()
                log.warning("sample %d failed: %s", self.parameters.sample_id[row], self.message[row])
            now = time.monotonic()
            if now - last > _REPORT_SECONDS or count == len(rows):
                left = (now - start) / count * (len(rows) - count)
                log.info("%s: %d of %d samples, %.0f s left", label, count, len(rows), left)
                last = now
        if len(rows) and not self.done.any():
            raise ArtifactError(f"{label}: every sample of the chunk failed; the first: {self.message[rows[0]]}")
