"""HDF5 artifacts, read after checks: arrays with units, provenance and a digest of their content."""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from warmlens.artifacts.atomic import ArtifactError, UnreadableNowError, file_digest
from warmlens.artifacts.checks import (
    UnusableFileError,
    array_seal,
    check_name,
    check_seal,
    dataset_names,
    inputs_attribute,
    json_attribute,
    number_attribute,
    read_array_seals,
    span_attribute,
    text_attribute,
    texts_attribute,
)
from warmlens.config.digest import canonical_json, settings_digest

SCHEMA_VERSION = 2  # 1 had text of variable length
_ERRNO = re.compile(r"errno = (\d+)")  # of HDF5, in the words of its errors
_OF_THE_FILE = frozenset({errno.EINVAL, errno.EOVERFLOW, errno.EFBIG, errno.EISDIR})  # damaged sizes and places
_REMEDY = "delete the file and run the campaign again: only it and what depends on it is recomputed"


@dataclass(frozen=True)
class Dataset:
    """One array of an artifact, with one name per dimension in `axes`.

    `unit` is as astropy writes it, "" for pure numbers; `description` is one line.
    """

    data: npt.NDArray[Any] | list[str]
    unit: str
    axes: tuple[str, ...]
    description: str


@dataclass(frozen=True)
class Header:
    """What an artifact at `path` states about itself: its attributes, without its contents.

    `digest` is the SHA-256 of metadata and datasets. `inputs` has for each name the "path" of the input, relative
    to the folder of the artifact, and the "digest" that it had. Code with uncommitted changes is `git_dirty`.
    `code_sha256` is the digest of the code that makes samples, `machine` has the processor and BLAS of the host;
    both are "" in artifacts of early versions.
    """

    path: Path
    stage: str
    schema: str
    schema_version: int
    digest: str
    settings: dict[str, Any]
    inputs: dict[str, dict[str, str]]
    seed_key: str
    span: tuple[int, int] | None
    package_version: str
    git_commit: str
    git_dirty: bool
    code_sha256: str
    created_utc: str
    wall_seconds: float
    machine: str = field(default="", kw_only=True)

    @property
    def code(self) -> str:
        """Version of the code: its digest, or the commit where it was not recorded."""
        return self.code_sha256 or self.git_commit

    @property
    def settings_sha256(self) -> str:
        """SHA-256 of the settings, computed from them."""
        return settings_digest(self.settings)


@dataclass(frozen=True)
class Artifact(Header):
    """An open artifact, with its header: `artifact["name"][...]` reads a dataset.

    What the file consists of, and every attribute, was checked when it was opened. A dataset is compared with its
    seal in `unchecked` when it is first asked for; a file of an early version has none (None).
    """

    file: h5py.File
    names: tuple[str, ...]
    metadata: dict[str, Any]
    unchecked: dict[str, str] | None

    @property
    def header(self) -> Header:
        """The header alone, to be kept when the file is closed."""
        return Header(**{name: getattr(self, name) for name in Header.__dataclass_fields__})

    def __getitem__(self, name: str) -> h5py.Dataset:
        """Return dataset `name`, not yet read."""
        if name not in self.names:
            raise ArtifactError(f"{self.path}: has no dataset {name!r}; it was written by other code: {_REMEDY}")
        if self.unchecked is not None and name in self.unchecked:
            with reading(self.path, f"dataset {name!r}"):
                if array_seal(self.file, name) != self.unchecked.pop(name):
                    raise UnusableFileError(f"dataset {name!r} has changed since it was written")
        return self.file[name]

    def array(self, name: str, rows: Any = ...) -> npt.NDArray[Any]:
        """Read a dataset of numbers, or the part of it that the index `rows` picks."""
        node = self[name]
        with reading(self.path, f"dataset {name!r}"):
            if node.dtype.kind == "S":
                raise UnusableFileError(f"dataset {name!r} is text, expected numbers")
            return node[rows]

    def strings(self, name: str) -> list[str]:
        """Read a dataset of strings."""
        node = self[name]
        with reading(self.path, f"dataset {name!r}"):
            if node.dtype.kind != "S":
                raise UnusableFileError(f"dataset {name!r} is numbers, expected text")
            return [text.decode() for text in node[...]]

    def text(self, name: str) -> str:
        """Read an attribute of the file that is text."""
        with reading(self.path, f"attribute {name!r}"):
            return text_attribute(self.file, name)

    def dataset(self, name: str) -> Dataset:
        """Read a dataset with its unit, axes and description."""
        node = self[name]
        data = self.strings(name) if node.dtype.kind == "S" else self.array(name)
        with reading(self.path, f"dataset {name!r}"):
            unit, description = text_attribute(node, "unit"), text_attribute(node, "description")
            axes = texts_attribute(node, "axes")
            if len(axes) != node.ndim:
                raise UnusableFileError(f"dataset {name!r} has {node.ndim} dimensions, but axes {axes}")
            return Dataset(data, unit, axes, description)


class _Recorded(dict[str, Any]):
    """JSON object of an artifact's metadata, which raises an `ArtifactError` for a key that it lacks."""

    def __init__(self, path: Path, content: Mapping[str, Any]) -> None:
        super().__init__(content)
        self._path = path

    def __missing__(self, key: str) -> Any:
        raise ArtifactError(f"{self._path}: its metadata have no {key!r}; it was written by other code: {_REMEDY}")


@contextlib.contextmanager
def reading(path: Path, what: str = "the file") -> Iterator[None]:
    """Turn any error while reading an artifact into an `ArtifactError` that names the file.

    h5py has no error class of its own, and the content of a hostile file may raise anything. An error of the
    system (no lock, no permission, a disk or network that fails) is no fault of the file.
    """
    try:
        yield
    except (ArtifactError, MemoryError):
        raise
    except OSError as error:
        raise _not_read(path, error, what) from error
    except UnusableFileError as error:
        raise ArtifactError(f"{path}: no artifact of this program: {error}; {_REMEDY}") from error
    except Exception as error:
        raise ArtifactError(f"{path}: {_damaged(error, what)}") from error


def _damaged(error: Exception, what: str) -> str:
    return f"{what} is damaged, or is not what its stage writes ({type(error).__name__}: {error}); {_REMEDY}"


def _not_read(path: Path, error: OSError, what: str, otherwise: str = "") -> ArtifactError:
    """Return the error for a file that cannot be read: the fault of the system, else `otherwise` or damage."""
    text = " ".join(str(error).split())
    if "already open for write" in text:
        return UnreadableNowError(
            f"{path}: {what} is being written by another program, or that was killed: end it, or {_REMEDY}"
        )
    words = _ERRNO.search(text)
    number = int(words[1]) if words else error.errno
    if number is None or number in _OF_THE_FILE:
        return ArtifactError(f"{path}: {otherwise or _damaged(error, what)}")
    lock = "set HDF5_USE_FILE_LOCKING=FALSE" if "lock" in text else "mend that"
    return UnreadableNowError(
        f"{path}: {what} cannot be read now: {os.strerror(number)} (errno {number}); {lock} and repeat the command"
    )


def content_digest(file: h5py.File, metadata: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the metadata and of the names, shapes, dtypes and bytes of all datasets."""
    sha = hashlib.sha256(canonical_json(metadata).encode())
    for name in dataset_names(file, Path(file.filename).stat().st_size):
        node = file[name]
        sha.update(f"\0{name}\0{node.shape}\0{node.dtype.str}\0".encode())
        sha.update(np.ascontiguousarray(node[...]).reshape(-1).view(np.uint8).data)  # not copied
    return sha.hexdigest()


@contextlib.contextmanager
def open_artifact(path: Path, *stages: str) -> Iterator[Artifact]:
    """Open an artifact for reading, after checking that it is complete and of one of the `stages`, if given."""
    if not path.exists():
        raise ArtifactError(f"{path}: no such artifact; run the campaign, which makes what is missing")
    if not path.is_file():
        raise ArtifactError(f"{path}: not a file, expected an artifact; remove it and run the campaign again")
    try:
        file = h5py.File(path, "r", locking=False)  # no lock is needed: a finished file is replaced, never changed
    except OSError as error:
        otherwise = f"not a readable HDF5 file ({error}); {_REMEDY}"
        raise _not_read(path, error, "the file", otherwise) from error
    with file:
        with reading(path):
            artifact = _checked(path, file)
        if stages and artifact.stage not in stages:
            expected = " or ".join(map(repr, stages))
            raise ArtifactError(f"{path}: holds stage {artifact.stage!r}, expected {expected}; {_REMEDY}")
        yield artifact


@contextlib.contextmanager
def open_input(path: Path, *stages: str) -> Iterator[Artifact]:
    """Open an artifact that another is computed from: its content is compared with what was written.

    Its datasets are compared with their seals when they are read. The content of a file of an early version, which
    has no such seals, is hashed, once per process.
    """
    with open_artifact(path, *stages) as artifact:
        if artifact.unchecked is None:
            with reading(path):
                _check_digest(path.resolve(), path.stat().st_mtime_ns, artifact.digest)
        yield artifact


@functools.cache
def _check_digest(path: Path, _written_ns: int, digest: str) -> None:
    with open_artifact(path) as artifact:
        if content_digest(artifact.file, artifact.metadata) != digest:
            raise UnusableFileError("its content has changed since it was written")


def _checked(path: Path, file: h5py.File) -> Artifact:
    """Read the header, and check what the file consists of."""
    if "complete" not in file.attrs or number_attribute(file, "complete") != 1:
        raise ArtifactError(f"{path}: incomplete or not a warmlens artifact; {_REMEDY}")
    version = number_attribute(file, "schema_version")
    if version != SCHEMA_VERSION:
        raise ArtifactError(f"{path}: schema version {version:g}, this program reads {SCHEMA_VERSION}; {_REMEDY}")
    names = dataset_names(file, path.stat().st_size)
    text_attribute(file, "settings_sha256")  # `Header` computes its own; no artifact lacks it
    artifact = Artifact(
        path=path,
        stage=text_attribute(file, "stage"),
        schema=text_attribute(file, "schema"),
        schema_version=SCHEMA_VERSION,
        digest=text_attribute(file, "digest"),
        settings=json_attribute(file, "settings"),
        inputs=inputs_attribute(file, "inputs"),
        seed_key=text_attribute(file, "seed_key"),
        span=span_attribute(file, "span"),
        package_version=text_attribute(file, "package_version"),
        git_commit=text_attribute(file, "git_commit"),
        git_dirty=bool(number_attribute(file, "git_dirty")),
        code_sha256=text_attribute(file, "code_sha256") if "code_sha256" in file.attrs else "",
        created_utc=text_attribute(file, "created_utc"),
        wall_seconds=number_attribute(file, "wall_seconds"),
        machine=text_attribute(file, "machine") if "machine" in file.attrs else "",
        file=file,
        names=names,
        metadata=json_attribute(file, "metadata", lambda content: _Recorded(path, content)),
        unchecked=read_array_seals(file, names),
    )
    check_seal(file, artifact.names)
    check_name(path.stem, artifact.span)
    return artifact


def read_header(path: Path, *stages: str) -> Header:
    """Open an artifact with all checks of `open_artifact`, and return its header."""
    with open_artifact(path, *stages) as artifact:
        return artifact.header


def input_digest(path: Path) -> str:
    """Return the digest of an input: of the content of an artifact, of the bytes of any other file."""
    if path.suffix == ".h5":
        return read_header(path).digest
    if not path.is_file():
        raise ArtifactError(f"{path}: not a file")
    return file_digest(path)
