"""HDF5 artifacts: written whole or not at all, with units, provenance and a digest of their content."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from warmlens import __version__

SCHEMA_VERSION = 1
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
    """An open artifact: `artifact["name"][...]` reads a dataset."""

    path: Path
    file: h5py.File
    stage: str
    digest: str
    metadata: dict[str, Any]
    settings: dict[str, Any]
    inputs: dict[str, dict[str, str]]
    span: tuple[int, int] | None
    wall_seconds: float

    def __getitem__(self, name: str) -> h5py.Dataset:
        """Dataset `name`, not yet read."""
        if name not in self.file:
            raise ArtifactError(f"{self.path}: has no dataset {name!r}; it was written by other code: run again")
        return self.file[name]

    def array(self, name: str) -> npt.NDArray[Any]:
        """Dataset `name`, read whole."""
        try:
            return self[name][...]
        except OSError as error:
            raise ArtifactError(f"{self.path}: dataset {name!r} is damaged ({error}); {_REMEDY}") from error

    def strings(self, name: str) -> list[str]:
        """Dataset `name` of strings, read whole."""
        return [text.decode() for text in self.array(name)]


_SPARE_BYTES = 2**20
_REMEDY = "delete the file and run the campaign again: only it and what depends on it is made anew"


def settings_digest(settings: Mapping[str, Any]) -> str:
    """SHA-256 of settings in canonical JSON."""
    return hashlib.sha256(canonical_json(settings).encode()).hexdigest()


def canonical_json(value: Mapping[str, Any]) -> str:
    """JSON with sorted keys and no blanks, the same for equal content."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


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
    path.parent.mkdir(parents=True, exist_ok=True)
    for abandoned in path.parent.glob(f".{path.name}.tmp-*"):  # of a killed job
        abandoned.unlink()
    temporary = path.with_name(f".{path.name}.tmp-{os.getpid()}")  # no name that a pattern *.h5 would match
    try:
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
        reason = f"the disk is full ({error})" if full else str(error)
        raise ArtifactError(
            f"{path}: could not be written: {reason}. Finished artifacts are intact; "
            "make room and start the campaign again"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


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
        digest = content_digest(file, metadata)
        file.attrs.update(
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
            }
        )
    return digest


def _write_dataset(file: h5py.File, name: str, dataset: Dataset) -> None:
    options: dict[str, Any] = {}
    if isinstance(dataset.data, list):
        data: Any = np.array([text.encode() for text in dataset.data], dtype=object)
        options["dtype"] = h5py.string_dtype()
    else:
        data = dataset.data
        if data.ndim != len(dataset.axes):
            raise ValueError(f"dataset {name!r}: {data.ndim} dimensions, but axes {dataset.axes}")
        if data.ndim and data.size:
            # One sample (or row) a chunk; checksums so that a flipped byte is an error, never a number.
            options.update(chunks=_chunk_shape(data), fletcher32=True)
            if data.ndim >= 2 and data.dtype == np.float32:
                options.update(shuffle=True, compression="gzip", compression_opts=1)
    node = file.create_dataset(name, data=data, **options)
    node.attrs.update({"unit": dataset.unit, "axes": list(dataset.axes), "description": dataset.description})


def _chunk_shape(data: npt.NDArray[Any]) -> tuple[int, ...]:
    """Whole rows along the first axis, about a MiB each."""
    row_bytes = max(1, data[0].nbytes)
    rows = int(np.clip(2**20 // row_bytes, 1, data.shape[0]))
    return (rows, *data.shape[1:])


def content_digest(file: h5py.File, metadata: Mapping[str, Any]) -> str:
    """SHA-256 over metadata and the names, shapes, dtypes and bytes of all datasets."""
    sha = hashlib.sha256(canonical_json(metadata).encode())
    names: list[str] = []
    file.visititems(lambda name, node: names.append(name) if isinstance(node, h5py.Dataset) else None)
    for name in sorted(names):
        node = file[name]
        sha.update(f"\0{name}\0{node.shape}\0{node.dtype.str}\0".encode())
        if h5py.check_string_dtype(node.dtype):
            for text in node[...]:
                sha.update(text + b"\0")
        else:
            sha.update(np.ascontiguousarray(node[...]).tobytes())
    return sha.hexdigest()


@contextlib.contextmanager
def open_artifact(path: Path, stage: str | None = None) -> Iterator[Artifact]:
    """Open an artifact for reading, after checking that it is complete and of the expected stage."""
    if not path.exists():
        raise ArtifactError(f"{path}: no such artifact; run the campaign, which makes what is missing")
    try:
        file = h5py.File(path, "r", locking="best-effort")
    except OSError as error:
        raise ArtifactError(f"{path}: not a readable HDF5 file ({error}); {_REMEDY}") from error
    with file:
        attrs = file.attrs
        if attrs.get("complete") != 1:
            raise ArtifactError(f"{path}: incomplete or not a warmlens artifact; {_REMEDY}")
        if attrs["schema_version"] != SCHEMA_VERSION:
            raise ArtifactError(
                f"{path}: schema version {attrs['schema_version']}, this program reads {SCHEMA_VERSION}; {_REMEDY}"
            )
        if stage is not None and attrs["stage"] != stage:
            raise ArtifactError(f"{path}: holds stage {attrs['stage']!r}, expected {stage!r}")
        span = tuple(int(edge) for edge in attrs["span"])
        yield Artifact(
            path=path,
            file=file,
            stage=str(attrs["stage"]),
            digest=str(attrs["digest"]),
            metadata=json.loads(attrs["metadata"]),
            settings=json.loads(attrs["settings"]),
            inputs=json.loads(attrs["inputs"]),
            span=(span[0], span[1]) if span else None,
            wall_seconds=float(attrs["wall_seconds"]),
        )


def input_digest(path: Path) -> str:
    """Digest of an input: of the content of an artifact, of the bytes of any other file."""
    if path.suffix == ".h5":
        with open_artifact(path) as artifact:
            return artifact.digest
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


@cache
def code_commit() -> tuple[str, bool]:
    """Git commit of the running code and whether it was changed since; ("unknown", False) outside git."""
    folder = Path(__file__).parent

    def git(*arguments: str) -> str | None:
        command = ["git", "-C", str(folder), *arguments]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except FileNotFoundError:
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    commit = git("rev-parse", "HEAD")
    tracked = git("ls-files", "--", str(folder / "artifacts.py"))
    if not commit or not tracked:
        return "unknown", False
    return commit, bool(git("status", "--porcelain", "--", str(folder)))
