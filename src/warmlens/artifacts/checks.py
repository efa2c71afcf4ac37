"""HDF5 files are data of unknown origin: check what an artifact consists of before anything is read.

An artifact holds plain arrays behind plain links, all stored in the file itself. Everything else that HDF5 knows
(links and storage in other files, virtual datasets, references, filters from plugins) is refused, and so is what
needs far more memory than the size of the file suggests.

Text must have a fixed length: text of variable length lies in a heap without checksums, in which HDF5 2.0
searches for ever if one byte is damaged.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import Any

import h5py

_MAX_DEPTH = 6  # groups within groups
_MAX_NODES = 2000
_MAX_INFLATED_BYTES = 2**32  # of a compressed dataset
_MAX_INFLATION = 1100  # deflate reaches 1032
_MAX_PACKED_BYTES = 2**22  # of a compressed chunk: what it inflates to is known only afterwards
_MAX_TEXT = 2**25  # of an attribute; metadata and inputs of the largest campaigns are below 2**21
_MAX_EDGE = 9_999_999  # of a span: file names have seven digits
_FILTERS = frozenset({h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32})
_SPAN_IN_NAME = re.compile(r"(?:chunk|shard)-(\d{7})-(\d{7})")
_SEALED = (
    *("schema", "stage", "package_version", "git_commit", "settings", "settings_sha256", "metadata", "inputs"),
    *("seed_key", "created_utc", "digest"),
)
_HASHED_BYTES = 2**20  # of a dataset: of a larger one the checksums are sealed
_CHECKSUM_BYTES = 4  # of a chunk with fletcher32, behind its data
_LAYOUTS = frozenset({h5py.h5d.COMPACT, h5py.h5d.CONTIGUOUS, h5py.h5d.CHUNKED})


class UnusableFileError(ValueError):
    """The file holds something that no artifact has."""


def dataset_names(file: h5py.File, file_bytes: int) -> tuple[str, ...]:
    """Return the sorted names of all datasets, after checking every group and dataset of a file of `file_bytes`.

    Raises
    ------
    UnusableFileError
        If something is reached by anything but one hard link, is nested too deep, or is no plain array that
        is stored in this file with the filters of an artifact.
    """
    names = []
    n_nodes = 0
    pending: list[tuple[str, h5py.h5g.GroupID]] = [("", file["/"].id)]
    while pending:
        prefix, group = pending.pop()
        for key in group:
            name, n_nodes = prefix + key.decode(), n_nodes + 1
            if n_nodes > _MAX_NODES:
                raise UnusableFileError(f"it has more than {_MAX_NODES} groups and datasets")
            if group.links.get_info(key).type != h5py.h5l.TYPE_HARD:
                raise UnusableFileError(f"{name!r} is a link to elsewhere")
            node = h5py.h5o.open(group, key)
            if h5py.h5o.get_info(node).rc != 1:
                raise UnusableFileError(f"{name!r} is linked more than once")
            if isinstance(node, h5py.h5d.DatasetID):
                _check_dataset(node, name, file_bytes)
                names.append(name)
            elif not isinstance(node, h5py.h5g.GroupID):
                raise UnusableFileError(f"{name!r} is neither a dataset nor a group")
            elif name.count("/") >= _MAX_DEPTH:
                raise UnusableFileError(f"its groups are nested more than {_MAX_DEPTH} deep")
            else:
                pending.append((f"{name}/", node))
    return tuple(sorted(names))


def _check_dataset(node: h5py.h5d.DatasetID, name: str, file_bytes: int) -> None:
    creation = node.get_create_plist()
    layout = creation.get_layout()
    if layout not in _LAYOUTS or creation.get_external_count():
        raise UnusableFileError(f"dataset {name!r} is stored in other files")
    filters = {creation.get_filter(i)[0] for i in range(creation.get_nfilters())}
    if not filters <= _FILTERS:
        raise UnusableFileError(f"dataset {name!r} needs filters that no artifact has")
    dtype, shape = node.dtype, node.shape
    if dtype.kind not in "biufS":
        raise UnusableFileError(f"dataset {name!r} is of type {dtype}, which is neither numbers nor text")
    if shape is None:
        raise UnusableFileError(f"dataset {name!r} is empty without a shape")
    n_bytes = math.prod(shape) * dtype.itemsize
    stored = node.get_storage_size()
    packed = h5py.h5z.FILTER_DEFLATE in filters
    limit = min(_MAX_INFLATION * stored, _MAX_INFLATED_BYTES) if packed else stored
    if stored > file_bytes or n_bytes > limit:
        raise UnusableFileError(f"dataset {name!r} declares shape {shape}, which is not what is stored")
    if layout == h5py.h5d.CHUNKED and any(chunk > n for chunk, n in zip(creation.get_chunk(), shape, strict=True)):
        raise UnusableFileError(f"dataset {name!r} has chunks that are larger than its own shape {shape}")
    if packed:
        _check_packed_chunks(node, name)


def _check_packed_chunks(node: h5py.h5d.DatasetID, name: str) -> None:
    sizes: list[int] = []
    node.chunk_iter(lambda chunk: sizes.append(chunk.size))
    if max(sizes, default=0) > _MAX_PACKED_BYTES:
        raise UnusableFileError(
            f"dataset {name!r} has a compressed chunk of {max(sizes)} bytes, too many to unpack"
        )


def text_attribute(node: h5py.HLObject, name: str) -> str:
    """Read an attribute that is one string of UTF-8."""
    attribute = _attribute(node, name)
    if attribute.shape != () or attribute.dtype.kind != "S":
        raise UnusableFileError(f"its attribute {name!r} is not text")
    if attribute.dtype.itemsize > _MAX_TEXT:
        raise UnusableFileError(f"its attribute {name!r} is {attribute.dtype.itemsize} bytes long")
    return _decoded(node.attrs[name], name)


def texts_attribute(node: h5py.HLObject, name: str) -> tuple[str, ...]:
    """Read an attribute that is a list of strings of UTF-8."""
    attribute = _attribute(node, name)
    if len(attribute.shape) != 1 or attribute.dtype.kind != "S":
        raise UnusableFileError(f"its attribute {name!r} is no list of texts")
    return tuple(_decoded(text, name) for text in node.attrs[name])


def _decoded(text: bytes, name: str) -> str:
    try:
        return text.decode()
    except UnicodeDecodeError:
        raise UnusableFileError(f"its attribute {name!r} is not text in UTF-8") from None


def json_attribute(
    node: h5py.HLObject, name: str, make: Callable[[dict[str, Any]], dict[str, Any]] = dict
) -> dict[str, Any]:
    """Read an attribute that is a JSON object; `make` builds every object in it."""
    try:
        value = json.loads(text_attribute(node, name), object_hook=make)
    except RecursionError:
        raise UnusableFileError(f"its attribute {name!r} is nested too deep") from None
    except ValueError as error:
        raise UnusableFileError(f"its attribute {name!r} is not JSON ({error})") from None
    if not isinstance(value, dict):
        raise UnusableFileError(f"its attribute {name!r} is not a JSON object")
    return value


def inputs_attribute(node: h5py.HLObject, name: str) -> dict[str, dict[str, str]]:
    """Read an attribute that records a path and a digest for every input."""
    inputs = json_attribute(node, name)
    for key, recorded in inputs.items():
        known = isinstance(recorded, dict) and recorded.keys() == {"path", "digest"}
        if not known or not all(isinstance(value, str) for value in recorded.values()):
            raise UnusableFileError(f"its input {key!r} is not recorded as a path and a digest")
    return inputs


def number_attribute(node: h5py.HLObject, name: str) -> float:
    """Read an attribute that is one finite number."""
    attribute = _attribute(node, name)
    numeric = attribute.shape == () and attribute.dtype.kind in "biuf"
    if not numeric or not math.isfinite(float(node.attrs[name])):
        raise UnusableFileError(f"its attribute {name!r} is not a finite number")
    return float(node.attrs[name])


def span_attribute(node: h5py.HLObject, name: str) -> tuple[int, int] | None:
    """Read an attribute that is a span (start, stop); None if it is empty."""
    attribute = _attribute(node, name)
    if attribute.dtype.kind not in "biuf" or attribute.shape not in ((0,), (2,)):
        raise UnusableFileError(f"its attribute {name!r} is no span")
    if attribute.shape == (0,):
        return None
    start, stop = (float(edge) for edge in node.attrs[name])
    if not (0 <= start < stop <= _MAX_EDGE and start.is_integer() and stop.is_integer()):
        raise UnusableFileError(f"its attribute {name!r} is [{start:g}, {stop:g}], which is no span")
    return int(start), int(stop)


def seal(file: h5py.File, names: Iterable[str]) -> str:
    """Return the SHA-256 of what HDF5 may have no checksum of: attributes that are text, datasets without chunks.

    Headers and chunks of arrays have checksums. With the seal, a flipped bit is detected in everything that is
    computed with, without hashing the large arrays. Units and descriptions of datasets are left out.
    """
    sha = hashlib.sha256()
    for name in _SEALED:
        sha.update(text_attribute(file, name).encode() + b"\0")
    for name in names:
        node = file[name]
        if not node.fletcher32:
            sha.update(name.encode() + b"\0" + node[...].tobytes() + b"\0")
    return sha.hexdigest()


def check_seal(file: h5py.File, names: Iterable[str]) -> None:
    """Refuse a file whose texts or single numbers have changed. Files of early versions have no seal."""
    if "seal" in file.attrs and text_attribute(file, "seal") != seal(file, names):
        raise UnusableFileError("its attributes, texts or single numbers have changed since it was written")


def array_seals(file: h5py.File, names: Iterable[str]) -> dict[str, str]:
    """Return the seal of every dataset of a file that has been flushed, see `array_seal`."""
    return {name: array_seal(file, name) for name in names}


def array_seal(file: h5py.File, name: str) -> str:
    """Return the SHA-256 of name, shape, type and description of a dataset, and of its content.

    Of a large dataset the content stands for the checksum of each chunk, which HDF5 compares when it reads it. So
    an array that was exchanged with another, or written anew in place, is detected without hashing it.
    """
    node = file[name]
    sha = hashlib.sha256(f"{name}\0{node.shape}\0{node.dtype.str}\0".encode())
    said = (text_attribute(node, "unit"), *texts_attribute(node, "axes"), text_attribute(node, "description"))
    sha.update("\0".join(said).encode())
    if not node.fletcher32 or node.nbytes <= _HASHED_BYTES:
        sha.update(node[...].tobytes())
        return sha.hexdigest()
    chunks: list[tuple[tuple[int, ...], int, int]] = []
    node.id.chunk_iter(
        lambda each: chunks.append((each.chunk_offset, each.filter_mask, each.byte_offset + each.size))
    )
    with Path(file.filename).open("rb") as stored:
        for offset, mask, end in sorted(chunks):
            stored.seek(end - _CHECKSUM_BYTES)
            sha.update(f"{offset}\0{mask}\0".encode() + stored.read(_CHECKSUM_BYTES))
    return sha.hexdigest()


def read_array_seals(file: h5py.File, names: Collection[str]) -> dict[str, str] | None:
    """Read the seal of each of the datasets `names`; None for a file of an early version, which has none."""
    if "arrays" not in file.attrs:
        return None
    seals = json_attribute(file, "arrays")
    if seals.keys() != set(names):
        changed = sorted(seals.keys() ^ set(names))
        raise UnusableFileError(f"datasets {changed[:3]} were removed or added since it was written")
    return seals


def check_name(stem: str, span: tuple[int, int] | None) -> None:
    """Refuse a chunk or shard that holds another span than in its name, as when two were swapped."""
    named = _SPAN_IN_NAME.fullmatch(stem)
    if named and span != (int(named[1]), int(named[2])):
        raise UnusableFileError(f"its name says {named[1]} to {named[2]}, but it holds {span}")


def _attribute(node: h5py.HLObject, name: str) -> h5py.h5a.AttrID:
    if not h5py.h5a.exists(node.id, name.encode()):
        raise UnusableFileError(f"it has no attribute {name!r}")
    return h5py.h5a.open(node.id, name.encode())
