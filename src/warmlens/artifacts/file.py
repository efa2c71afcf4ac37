"""HDF5 artifacts: written whole or not at all, with units, provenance and a digest of their content."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from warmlens import __version__
from warmlens.artifacts.checks import (
    UnusableFileError,
    check_name,
    check_seal,
    dataset_names,
    inputs_attribute,
    json_attribute,
    number_attribute,
    seal,
    span_attribute,
    text_attribute,
    texts_attribute,
)
from warmlens.artifacts.code_version import code_commit
from warmlens.config.digest import canonical_json, settings_digest

SCHEMA_VERSION = 2  # 1 had text of variable length
_LIBVER = ("v110", "v110")


class ArtifactError(RuntimeError):
    """An artifact that is missing, damaged, of another kind, or cannot be written."""


@dataclass(frozen=True)
class Dataset:
    """One array of an artifact.

    Attributes
    ----------
    data
        Numbers of any shape, or a list of strings.
    unit
        As astropy writes it; "" for pure numbers.
    axes
        A name per dimension.
    description
        One line.
    """

    data: npt.NDArray[Any] | list[str]
    unit: str
    axes: tuple[str, ...]
    description: str


@dataclass(frozen=True)
class Provenance:
    """Where an artifact comes from: its stage, the settings that shaped it, its inputs."""

    stage: str
    settings: Mapping[str, Any]
    inputs: Mapping[str, Path] = field(default_factory=dict)
    seed_key: str = ""
    span: tuple[int, int] | None = None
    started: float = field(default_factory=time.monotonic)


@dataclass(frozen=True)
class Artifact:
    """An open artifact: `artifact["name"][...]` reads a dataset.

    What the file consists of, and every attribute, was checked when it was opened.
    """

    path: Path
    file: h5py.File
    names: tuple[str, ...]
    stage: str
    digest: str
    metadata: dict[str, Any]
    settings: dict[str, Any]
    inputs: dict[str, dict[str, str]]
    span: tuple[int, int] | None
    wall_seconds: float
    git_dirty: bool

    def __getitem__(self, name: str) -> h5py.Dataset:
        """Dataset `name`, not yet read."""
        if name not in self.names:
            raise ArtifactError(f"{self.path}: has no dataset {name!r}; it was written by other code: {_REMEDY}")
        return self.file[name]

    def array(self, name: str, rows: Any = ...) -> npt.NDArray[Any]:
        """Dataset `name` of numbers, read whole, or what an index picks of it."""
        node = self[name]
        with reading(self.path, f"dataset {name!r}"):
            if node.dtype.kind == "S":
                raise UnusableFileError(f"dataset {name!r} is text, expected numbers")
            return node[rows]

    def strings(self, name: str) -> list[str]:
        """Dataset `name` of strings, read whole."""
        node = self[name]
        with reading(self.path, f"dataset {name!r}"):
            if node.dtype.kind != "S":
                raise UnusableFileError(f"dataset {name!r} is numbers, expected text")
            return [text.decode() for text in node[...]]

    def text(self, name: str) -> str:
        """Attribute `name` of the file, which is text."""
        with reading(self.path, f"attribute {name!r}"):
            return text_attribute(self.file, name)

    def dataset(self, name: str) -> Dataset:
        """Dataset `name`, read whole with its unit, axes and description."""
        node = self[name]
        data = self.strings(name) if node.dtype.kind == "S" else self.array(name)
        with reading(self.path, f"dataset {name!r}"):
            unit, description = text_attribute(node, "unit"), text_attribute(node, "description")
            axes = texts_attribute(node, "axes")
            if len(axes) != node.ndim:
                raise UnusableFileError(f"dataset {name!r} has {node.ndim} dimensions, but axes {axes}")
            return Dataset(data, unit, axes, description)


class _Recorded(dict[str, Any]):
    """JSON object of an artifact's metadata: a key that it lacks is an error that names the file."""

    def __init__(self, path: Path, content: Mapping[str, Any]) -> None:
        super().__init__(content)
        self._path = path

    def __missing__(self, key: str) -> Any:
        raise ArtifactError(f"{self._path}: its metadata have no {key!r}; it was written by other code: {_REMEDY}")


_SPARE_BYTES = 2**20
_DESCRIPTIVE = ("schema", "package_version", "git_commit", "settings_sha256", "seed_key", "created_utc")
_REMEDY = "delete the file and run the campaign again: only it and what depends on it is made anew"


@contextlib.contextmanager
def reading(path: Path, what: str = "the file") -> Iterator[None]:
    """Whatever goes wrong while an artifact is read, as an `ArtifactError` that names it.

    h5py has no error class of its own, and what a file of other origin holds may fit nothing that is read.
    """
    try:
        yield
    except (ArtifactError, MemoryError):
        raise
    except UnusableFileError as error:
        raise ArtifactError(f"{path}: no artifact of this program: {error}; {_REMEDY}") from error
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise ArtifactError(
            f"{path}: {what} is damaged, or is not what its stage writes ({reason}); {_REMEDY}"
        ) from error


def write_artifact(
    path: Path, provenance: Provenance, datasets: Mapping[str, Dataset], metadata: Mapping[str, Any]
) -> str:
    """Write an artifact to a temporary name, sync, rename; return its digest.

    Raises
    ------
    ArtifactError
        If the disk is full or the folder cannot be written; no partial file is left.
    """
    n_bytes = sum(item.data.nbytes for item in datasets.values() if not isinstance(item.data, list))
    with atomic_path(path, n_bytes) as temporary:
        return _write_file(temporary, provenance, datasets, metadata, path.parent)


@contextlib.contextmanager
def atomic_path(path: Path, n_bytes: int = 0) -> Iterator[Path]:
    """A temporary name beside `path` to write to; synced and renamed when all went well, removed otherwise.

    Parameters
    ----------
    path
        File to make.
    n_bytes
        About how large it will be. Room is asked for first: HDF5 ends badly on a disk that fills up under it.

    Raises
    ------
    ArtifactError
        If there is no room, or the file cannot be written.
    """
    temporary = path.with_name(f".{path.name}.tmp-{os.getpid()}")  # no name that a pattern *.h5 would match
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for abandoned in path.parent.glob(f".{path.name}.tmp-*"):  # of a killed job
            abandoned.unlink()
        free = shutil.disk_usage(path.parent).free
        if free < n_bytes + _SPARE_BYTES:
            raise OSError(errno.ENOSPC, f"{free / 2**20:.0f} MiB free, {n_bytes / 2**20:.0f} MiB needed")
        yield temporary
        with temporary.open("rb") as handle:
            os.fsync(handle.fileno())
        temporary.replace(path)
    except (OSError, RuntimeError) as error:  # h5py reports a failed flush as RuntimeError
        if isinstance(error, ArtifactError):
            raise
        full = getattr(error, "errno", None) == errno.ENOSPC or "No space left" in str(error)
        reason, remedy = (f"the disk is full ({error})", "make room") if full else (str(error), "mend that")
        raise ArtifactError(
            f"{path}: could not be written: {reason}. Finished artifacts are intact; "
            f"{remedy} and start the campaign again"
        ) from error
    finally:
        if temporary.exists():  # on a read-only disk nothing can be removed, though nothing is there
            temporary.unlink()


def _write_file(
    target: Path,
    provenance: Provenance,
    datasets: Mapping[str, Dataset],
    metadata: Mapping[str, Any],
    folder: Path,
) -> str:
    inputs = {
        name: {"path": os.path.relpath(source, folder), "digest": input_digest(source)}
        for name, source in provenance.inputs.items()
    }
    commit, dirty = code_commit()
    with h5py.File(target, "w", libver=_LIBVER, track_order=True) as file:
        for name, dataset in datasets.items():
            _write_dataset(file, name, dataset)
        file.flush()
        digest = content_digest(file, metadata)
        _set_attributes(
            file,
            {
                "schema": f"warmlens/{provenance.stage}",
                "schema_version": SCHEMA_VERSION,
                "stage": provenance.stage,
                "package_version": __version__,
                "git_commit": commit,
                "git_dirty": dirty,
                "settings": canonical_json(provenance.settings),
                "settings_sha256": settings_digest(provenance.settings),
                "metadata": canonical_json(metadata),
                "inputs": canonical_json(inputs),
                "seed_key": provenance.seed_key,
                "span": provenance.span or (),
                "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
                "wall_seconds": time.monotonic() - provenance.started,
                "digest": digest,
                "complete": 1,
            },
        )
        _set_attributes(file, {"seal": seal(file, dataset_names(file, target.stat().st_size))})
    return digest


def _write_dataset(file: h5py.File, name: str, dataset: Dataset) -> None:
    options: dict[str, Any] = {}
    data = _fixed_length(dataset.data) if isinstance(dataset.data, list) else dataset.data
    if data.ndim != len(dataset.axes):
        raise ValueError(f"dataset {name!r}: {data.ndim} dimensions, but axes {dataset.axes}")
    if data.ndim and data.size:
        # One sample (or row) a chunk; checksums so that a flipped byte is an error, never a number.
        options.update(chunks=_chunk_shape(data), fletcher32=True)
        if data.dtype.kind == "S" or (data.ndim >= 2 and data.dtype == np.float32):
            options.update(shuffle=data.dtype.kind == "f", compression="gzip", compression_opts=1)
    node = file.create_dataset(name, data=data, **options)
    _set_attributes(
        node, {"unit": dataset.unit, "axes": _fixed_length(dataset.axes), "description": dataset.description}
    )


def _set_attributes(node: h5py.HLObject, values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        node.attrs[name] = _fixed_length([value]).reshape(()) if isinstance(value, str) else value


def _fixed_length(texts: Sequence[str]) -> npt.NDArray[np.bytes_]:
    """Strings in UTF-8, padded to the longest."""
    if any("\0" in text for text in texts):
        raise ValueError("text with a zero byte, which HDF5 takes for its end")
    encoded = [text.encode() for text in texts]
    return np.array(encoded, dtype=h5py.string_dtype("utf-8", max([1, *map(len, encoded)])))


def _chunk_shape(data: npt.NDArray[Any]) -> tuple[int, ...]:
    """Whole rows along the first axis, about a MiB each."""
    row_bytes = max(1, data[:1].nbytes)
    rows = int(np.clip(2**20 // row_bytes, 1, data.shape[0]))
    return (rows, *data.shape[1:])


def content_digest(file: h5py.File, metadata: Mapping[str, Any]) -> str:
    """SHA-256 over metadata and the names, shapes, dtypes and bytes of all datasets."""
    sha = hashlib.sha256(canonical_json(metadata).encode())
    for name in dataset_names(file, Path(file.filename).stat().st_size):
        node = file[name]
        sha.update(f"\0{name}\0{node.shape}\0{node.dtype.str}\0".encode())
        sha.update(np.ascontiguousarray(node[...]).reshape(-1).view(np.uint8).data)  # not copied
    return sha.hexdigest()


@contextlib.contextmanager
def open_artifact(path: Path, *stages: str) -> Iterator[Artifact]:
    """Open an artifact for reading, after checking that it is complete and of one of the stages, if given."""
    if not path.exists():
        raise ArtifactError(f"{path}: no such artifact; run the campaign, which makes what is missing")
    if not path.is_file():
        raise ArtifactError(f"{path}: not a file, expected an artifact; remove it and run the campaign again")
    try:
        file = h5py.File(path, "r", locking="best-effort")
    except OSError as error:
        raise ArtifactError(f"{path}: not a readable HDF5 file ({error}); {_REMEDY}") from error
    with file:
        with reading(path):
            artifact = _checked(path, file)
        if stages and artifact.stage not in stages:
            expected = " or ".join(map(repr, stages))
            raise ArtifactError(f"{path}: holds stage {artifact.stage!r}, expected {expected}; {_REMEDY}")
        yield artifact


def _checked(path: Path, file: h5py.File) -> Artifact:
    """Check the header and what the file consists of."""
    if "complete" not in file.attrs or number_attribute(file, "complete") != 1:
        raise ArtifactError(f"{path}: incomplete or not a warmlens artifact; {_REMEDY}")
    version = number_attribute(file, "schema_version")
    if version != SCHEMA_VERSION:
        raise ArtifactError(f"{path}: schema version {version:g}, this program reads {SCHEMA_VERSION}; {_REMEDY}")
    for name in _DESCRIPTIVE:
        text_attribute(file, name)
    names = dataset_names(file, path.stat().st_size)
    artifact = Artifact(
        path=path,
        file=file,
        names=names,
        stage=text_attribute(file, "stage"),
        digest=text_attribute(file, "digest"),
        metadata=json_attribute(file, "metadata", lambda content: _Recorded(path, content)),
        settings=json_attribute(file, "settings"),
        inputs=inputs_attribute(file, "inputs"),
        span=span_attribute(file, "span"),
        wall_seconds=number_attribute(file, "wall_seconds"),
        git_dirty=bool(number_attribute(file, "git_dirty")),
    )
    check_seal(file, names)
    check_name(path.stem, artifact.span)
    return artifact


def input_digest(path: Path) -> str:
    """Digest of an input: of the content of an artifact, of the bytes of any other file."""
    if path.suffix == ".h5":
        with open_artifact(path) as artifact:
            return artifact.digest
    if not path.is_file():
        raise ArtifactError(f"{path}: not a file")
    return file_digest(path)


def file_digest(path: Path) -> str:
    """SHA-256 of the bytes of a file."""
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
