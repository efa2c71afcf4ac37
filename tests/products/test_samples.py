from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.products.samples import FAILED_HERE, FAILED_UPSTREAM, OK, SampleTable
from warmlens.sampling import draw_parameters


def _table(n: int = 5) -> SampleTable:
    return SampleTable(draw_parameters(1, (10, 10 + n), (1.0, 5.0), (13.0, 13.5)))


def test_a_failing_sample_is_recorded_and_the_others_go_on(tmp_path: Path) -> None:
    table, seen = _table(), []

    def work(row: int) -> None:
        if row == 2:
            raise FloatingPointError("no number")
        seen.append(row)

    table.for_each(work, "halos")
    assert seen == [0, 1, 3, 4]
    assert table.status.tolist() == [OK, OK, FAILED_HERE, OK, OK]
    assert table.message[2] == "halos: FloatingPointError: no number"
    assert "in work" in table.trace[2]

    write_artifact(tmp_path / "a.h5", Provenance("halos", {}), table.datasets(), {})
    with open_artifact(tmp_path / "a.h5") as artifact:
        later = SampleTable.read(artifact)
    assert later.status.tolist() == [OK, OK, FAILED_UPSTREAM, OK, OK]
    assert later.message == table.message
    later.for_each(seen.append, "mocks")
    assert seen[4:] == [0, 1, 3, 4]
    assert np.array_equal(later.parameters.sample_id, [10, 11, 12, 13, 14])


@pytest.mark.parametrize("error", [OSError("disk"), MemoryError()])
def test_errors_of_the_machine_end_the_job(error: Exception) -> None:
    def work(row: int) -> None:
        raise error

    with pytest.raises(type(error)):
        _table().for_each(work, "halos")


def test_a_chunk_of_which_nothing_is_left_is_an_error() -> None:
    def work(row: int) -> None:
        raise ValueError("wrong")

    with pytest.raises(
        ArtifactError, match="every sample of the chunk failed; the first: halos: ValueError: wrong"
    ):
        _table().for_each(work, "halos")
