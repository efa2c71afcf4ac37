from __future__ import annotations

import errno
import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from warmlens.artifacts import atomic
from warmlens.artifacts import file as artifacts
from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Dataset, open_artifact, open_input
from warmlens.artifacts.writing import Provenance, write_artifact

from ..reliability import Outcome, fault


def _datasets(value: float = 1.0) -> dict[str, Dataset]:
    rng = np.random.default_rng(5)
    return {
        "group/maps": Dataset(rng.normal(size=(40, 20, 30)).astype(np.float32), "arcsec", ("n", "y", "x"), "maps"),
        "numbers": Dataset(np.array([value, np.nan, np.inf]), "keV", ("n",), "numbers"),
        "empty": Dataset(np.empty(0), "", ("n",), "nothing"),
        "words": Dataset(["", "deux", "trois — ☉"], "", ("n",), "text"),
    }


def _write(path: Path, value: float = 1.0, metadata: dict[str, Any] | None = None) -> str:
    return write_artifact(path, Provenance("halos", {"a": 1}, span=(0, 3)), _datasets(value), metadata or {})


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "folder/a.h5"
    digest = _write(path, metadata={"bands": ["x"], "number": 1.5})
    with open_artifact(path, "halos") as artifact:
        assert artifact.digest == digest
        assert artifact.metadata == {"bands": ["x"], "number": 1.5}
        assert artifact.settings == {"a": 1}
        assert artifact.span == (0, 3)
        assert artifact.strings("words") == ["", "deux", "trois — ☉"]
        for name, dataset in _datasets().items():
            assert replace(artifact.dataset(name), data=dataset.data) == dataset
            if not isinstance(dataset.data, list):
                assert np.array_equal(artifact.array(name), dataset.data, equal_nan=True)
                assert artifact.array(name).dtype == dataset.data.dtype
    assert [file.name for file in path.parent.iterdir()] == ["a.h5"]


def test_digest_is_of_the_content(tmp_path: Path) -> None:
    first, again = _write(tmp_path / "a.h5"), _write(tmp_path / "b.h5")
    assert first == again
    assert _write(tmp_path / "c.h5", value=2.0) != first
    assert _write(tmp_path / "d.h5", metadata={"note": 1}) != first


def test_provenance(tmp_path: Path) -> None:
    digest = _write(tmp_path / "in.h5")
    (tmp_path / "in.fits").write_bytes(b"image")
    inputs = {"one": tmp_path / "in.h5", "two": tmp_path / "in.fits"}
    write_artifact(tmp_path / "sub/out.h5", Provenance("mocks", {}, inputs, seed_key="1/x"), {}, {})
    with open_artifact(tmp_path / "sub/out.h5") as artifact:
        assert artifact.inputs["one"] == {"path": "../in.h5", "digest": digest}
        assert artifact.inputs["two"]["path"] == "../in.fits"
        assert artifact.text("seed_key") == "1/x"
        assert {"package_version", "git_commit", "created_utc", "settings_sha256"} <= set(artifact.file.attrs)


def test_full_disk_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _write(tmp_path / "a.h5")
    before = (tmp_path / "a.h5").read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(atomic.os, "fsync", full)
    with pytest.raises(ArtifactError, match=r"a\.h5: could not be written: the disk is full"):
        _write(tmp_path / "a.h5", value=3.0)
    assert (tmp_path / "a.h5").read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["a.h5"]


def test_what_a_killed_job_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / ".a.h5.tmp-123").write_bytes(b"half")
    _write(tmp_path / "a.h5")
    assert [file.name for file in tmp_path.iterdir()] == ["a.h5"]


def test_room_is_asked_for_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(atomic.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, 10**6))
    with pytest.raises(ArtifactError, match=r"the disk is full .*1 MiB free, 0 MiB needed"):
        _write(tmp_path / "a.h5")
    monkeypatch.undo()
    _write(tmp_path / "a.h5")
    assert [file.name for file in tmp_path.iterdir()] == ["a.h5"]


def test_flipped_bytes_are_never_a_number(tmp_path: Path) -> None:
    """Every flip is an error, a changed digest, or lies in unused space: never silently other data."""
    path = tmp_path / "a.h5"
    _write(path)
    intact = path.read_bytes()
    expected = {name: data.data for name, data in _datasets().items() if name != "words"}
    noticed = 0
    for position in range(600, len(intact), len(intact) // 150):
        damaged = bytearray(intact)
        damaged[position] ^= 0xFF
        path.write_bytes(damaged)
        try:
            with open_artifact(path, "halos") as artifact:
                for name, data in expected.items():
                    assert np.array_equal(artifact.array(name), data, equal_nan=True)
        except (ArtifactError, OSError, KeyError, RuntimeError, ValueError, UnicodeDecodeError):
            noticed += 1
    assert noticed > 100


def test_errors_name_the_file(tmp_path: Path) -> None:
    with (
        pytest.raises(ArtifactError, match=r"absent\.h5: no such artifact"),
        open_artifact(tmp_path / "absent.h5"),
    ):
        pass
    path = tmp_path / "a.h5"
    _write(path)
    with (
        pytest.raises(ArtifactError, match="holds stage 'halos', expected 'mocks'"),
        open_artifact(path, "mocks"),
    ):
        pass
    with open_artifact(path) as artifact, pytest.raises(ArtifactError, match="has no dataset 'scan'"):
        artifact.array("scan")
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(ArtifactError, match=r"a\.h5: not a readable HDF5 file"), open_artifact(path):
        pass
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(ArtifactError, match="not a warmlens artifact"), open_artifact(tmp_path / "other.h5"):
        pass


def test_axes_must_fit(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="2 dimensions, but axes"):
        write_artifact(
            tmp_path / "a.h5", Provenance("halos", {}), {"x": Dataset(np.ones((2, 2)), "", ("n",), "")}, {}
        )
    assert not list(tmp_path.iterdir())


def test_no_flipped_bit_is_read(tmp_path: Path) -> None:
    """Arrays and headers have HDF5's checksums, everything else the seal."""
    path = tmp_path / "a.h5"
    datasets = {
        "maps": Dataset(np.arange(150.0, dtype=np.float32).reshape(6, 5, 5), "", ("n", "y", "x"), "maps"),
        "numbers": Dataset(np.arange(3.0), "keV", ("n",), "numbers"),
        "one": Dataset(np.array(3.5), "", (), "a number"),
        "words": Dataset(["", "deux"], "", ("n",), "text"),
    }
    metadata = {"bound": 2.5, "note": "x" * 5000}
    write_artifact(path, Provenance("halos", {"a": 1}, span=(0, 6)), datasets, metadata)
    content = path.read_bytes()

    def read() -> tuple[Any, ...]:
        with open_artifact(path) as artifact:
            arrays = [artifact.array(name).tobytes() for name in ("maps", "numbers", "one")]
            whole = (artifact.stage, artifact.digest, artifact.metadata, artifact.settings, artifact.span)
            return (*whole, *arrays, artifact.strings("words"))

    expected, refused = read(), 0
    for place in range(0, len(content), 41):
        damaged = bytearray(content)
        damaged[place] ^= 1 << (place % 8)
        path.write_bytes(damaged)
        try:
            assert read() == expected, f"byte {place} is flipped"
        except ArtifactError:
            refused += 1
    assert refused > 100, "most bytes of the file hold something"


def test_what_the_seal_is_for(tmp_path: Path) -> None:
    """A digit of the metadata: HDF5 has no checksum of an attribute above 4 kB."""
    path = tmp_path / "a.h5"
    _write(path, metadata={"bound": 2.5, "note": "x" * 5000})
    path.write_bytes(path.read_bytes().replace(b'"bound":2.5', b'"bound":2.7'))
    with (
        pytest.raises(ArtifactError, match="have changed since it was written; delete the file"),
        open_artifact(path),
    ):
        pass
    with h5py.File(path, "r+") as file:
        del file.attrs["seal"]
    with open_artifact(path) as artifact:  # one of an early version
        assert artifact.metadata["bound"] == 2.7


LARGE = Dataset(np.arange(6e5, dtype=np.float32).reshape(6, 100, 1000), "arcsec", ("n", "y", "x"), "2.4 MB")


def _exchange(file: h5py.File) -> None:
    file.move("a/large", "aside")
    file.move("b/large", "a/large")
    file.move("aside", "b/large")


def _exchange_groups(file: h5py.File) -> None:
    file.move("a", "aside")
    file.move("b", "a")
    file.move("aside", "b")


def _exchange_rows(file: h5py.File) -> None:
    node = file["a/large"]
    node[...] = node[...][[0, 2, 1, 3, 4, 5]]


def _exchange_small_rows(file: h5py.File) -> None:
    file["a/small"][...] = file["a/small"][...][::-1]


def _one_number(file: h5py.File) -> None:
    file["a/large"][5, 99, 999] += 1.0


def _other_type(file: h5py.File) -> None:
    data, attributes = file["a/large"][...].astype(np.float64), dict(file["a/large"].attrs)
    del file["a/large"]
    file.create_dataset("a/large", data=data, fletcher32=True, chunks=(1, 100, 1000)).attrs.update(attributes)


def _removed(file: h5py.File) -> None:
    del file["b/small"]


def _added(file: h5py.File) -> None:
    file["a/more"] = np.ones(3)


def _other_unit(file: h5py.File) -> None:
    file["a/large"].attrs["unit"] = np.bytes_("mas")


def _other_axes(file: h5py.File) -> None:
    file["a/large"].attrs["axes"] = file["a/large"].attrs["axes"][::-1]


CHANGES = [
    *(_exchange, _exchange_groups, _exchange_rows, _exchange_small_rows, _one_number, _other_type),
    *(_removed, _added, _other_unit, _other_axes),
]


@pytest.mark.parametrize("change", CHANGES)
def test_no_array_is_read_that_is_not_as_it_was_written(tmp_path: Path, change: Callable[..., None]) -> None:
    path = _in_two_bands(tmp_path)
    _read_all(path)
    with h5py.File(path, "r+") as file:
        change(file)
    with (
        pytest.raises(ArtifactError, match="since it was written; delete the file"),
        open_artifact(path) as artifact,
    ):
        for name in artifact.names:
            artifact.array(name)


@pytest.mark.parametrize("change", CHANGES)
def test_inputs_of_early_versions_are_hashed(tmp_path: Path, change: Callable[..., None]) -> None:
    path = _in_two_bands(tmp_path)
    with h5py.File(path, "r+") as file:
        del file.attrs["arrays"], file.attrs["machine"]
    with open_input(path) as artifact:
        assert artifact.machine == "" and artifact.array("a/large").shape == (6, 100, 1000)
    os.utime(path, ns=(1, 1))
    with h5py.File(path, "r+") as file:
        change(file)
    if change in (_other_unit, _other_axes):  # which the digest does not hold
        return
    with pytest.raises(ArtifactError, match="changed since it was written"), open_input(path):
        pass


def _read_all(path: Path) -> None:
    with open_artifact(path) as artifact:
        for name in artifact.names:
            artifact.array(name)


def _in_two_bands(folder: Path) -> Path:
    small = Dataset(np.arange(4.0), "keV", ("n",), "numbers")
    other = replace(LARGE, data=LARGE.data[::-1])
    datasets = {"a/large": LARGE, "b/large": other, "a/small": small, "b/small": small}
    write_artifact(folder / "a.h5", Provenance("halos", {}), datasets, {})
    return folder / "a.h5"


def test_what_is_not_read_is_not_hashed(tmp_path: Path) -> None:
    """The seals of arrays cost the header nothing, and a large array its checksums alone."""
    path = _in_two_bands(tmp_path)
    with open_artifact(path) as artifact:
        artifact.array("a/large")
        assert artifact.unchecked is not None and set(artifact.unchecked) == {"b/large", "a/small", "b/small"}


@fault("Machine", "another program has locked an artifact", "flock on it, as HDF5 locks; it is read", quick=True)
def test_a_locked_file_is_read(tmp_path: Path, outcome: Outcome) -> None:
    _write(tmp_path / "a.h5")
    with (tmp_path / "a.h5").open("r+b") as other:
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with open_artifact(tmp_path / "a.h5") as artifact:
            artifact.array("numbers")
        assert _write(tmp_path / "a.h5", value=2.0), "it is replaced, too"
    outcome.goes_on("read and replaced: no lock is asked for", "nothing")


@fault("Machine", "the system refuses to read or lock a file", "errors 5, 11, 13, 37, 95, 116, 524", quick=True)
@pytest.mark.parametrize("number", [errno.EIO, errno.EAGAIN, errno.EACCES, errno.ENOLCK, 95, errno.ESTALE, 524])
def test_a_file_is_not_blamed_for_the_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, outcome: Outcome, number: int
) -> None:
    _write(tmp_path / "a.h5")
    what = "unable to lock file" if number in (errno.EAGAIN, errno.ENOLCK, 95, 524) else "file read failed"

    def fail(*_: Any, **__: Any) -> None:
        raise OSError(f"Unable to synchronously open file ({what}, errno = {number}, error message = '...')")

    monkeypatch.setattr(artifacts.h5py, "File", fail)
    with pytest.raises(ArtifactError) as error, open_artifact(tmp_path / "a.h5"):
        pass
    assert "delete" not in str(error.value)
    outcome.stops(str(error.value), "cannot be read now", f"errno {number}", "a.h5", "repeat the command")


def test_a_file_that_is_being_written_by_another_program(tmp_path: Path) -> None:
    _write(tmp_path / "a.h5")
    writer = "import h5py, os, sys; file = h5py.File(sys.argv[1], 'r+'); file.flush(); os._exit(0)"
    subprocess.run([sys.executable, "-c", writer, str(tmp_path / "a.h5")], check=True)  # killed
    with pytest.raises(
        ArtifactError, match="is being written by another program, or that was killed: end it, or "
    ):
        open_artifact(tmp_path / "a.h5").__enter__()


def test_a_chunk_that_holds_another_span(tmp_path: Path) -> None:
    path = tmp_path / "chunk-0000000-0000003.h5"
    _write(path)
    with open_artifact(path):
        pass
    swapped = path.rename(tmp_path / "chunk-0000003-0000006.h5")
    with (
        pytest.raises(
            ArtifactError, match=r"its name says 0000003 to 0000006, but it holds \(0, 3\); delete the file"
        ),
        open_artifact(swapped),
    ):
        pass
