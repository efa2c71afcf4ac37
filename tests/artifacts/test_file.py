from __future__ import annotations

import errno
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from warmlens.artifacts import file as artifacts
from warmlens.artifacts.file import ArtifactError, Dataset, Provenance, open_artifact, write_artifact


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

    monkeypatch.setattr(artifacts.os, "fsync", full)
    with pytest.raises(ArtifactError, match=r"a\.h5: could not be written: the disk is full"):
        _write(tmp_path / "a.h5", value=3.0)
    assert (tmp_path / "a.h5").read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["a.h5"]


def test_what_a_killed_job_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / ".a.h5.tmp-123").write_bytes(b"half")
    _write(tmp_path / "a.h5")
    assert [file.name for file in tmp_path.iterdir()] == ["a.h5"]


def test_room_is_asked_for_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(artifacts.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, 10**6))
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
