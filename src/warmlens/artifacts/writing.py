"""Writing an artifact: chunks with checksums, seals, provenance, and a digest of the content."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from warmlens import __version__, runtime
from warmlens.artifacts.atomic import atomic_path
from warmlens.artifacts.checks import array_seals, dataset_names, seal
from warmlens.artifacts.code_version import code_commit, sample_code_digest
from warmlens.artifacts.file import SCHEMA_VERSION, Dataset, content_digest, input_digest
from warmlens.config.digest import canonical_json, settings_digest

_LIBVER = ("v110", "v110")


@dataclass(frozen=True)
class Provenance:
    """Where an artifact comes from: its stage, the settings that shaped it, its inputs."""

    stage: str
    settings: Mapping[str, Any]
    inputs: Mapping[str, Path] = field(default_factory=dict)
    seed_key: str = ""
    span: tuple[int, int] | None = None
    started: float = field(default_factory=time.monotonic)


def write_artifact(
    path: Path, provenance: Provenance, datasets: Mapping[str, Dataset], metadata: Mapping[str, Any]
) -> str:
    """Write an artifact to a temporary name, sync, rename; return its digest.

    Raises
    ------
    ArtifactError
        If the disk is full or the folder cannot be written; no partial file is left.
    """
    n_bytes = sum(each.data.nbytes for each in datasets.values() if not isinstance(each.data, list))
    commit, dirty = code_commit()
    with atomic_path(path, n_bytes) as temporary:
        inputs = {
            name: {"path": os.path.relpath(source, path.parent), "digest": input_digest(source)}
            for name, source in provenance.inputs.items()
        }
        with h5py.File(temporary, "w", libver=_LIBVER, track_order=True, locking=False) as file:
            for name, dataset in datasets.items():
                _write_dataset(file, name, dataset)
            file.flush()
            digest = content_digest(file, metadata)
            attributes = {
                "schema": f"warmlens/{provenance.stage}",
                "schema_version": SCHEMA_VERSION,
                "stage": provenance.stage,
                "package_version": __version__,
                "git_commit": commit,
                "git_dirty": dirty,
                "code_sha256": sample_code_digest(),
                "settings": canonical_json(provenance.settings),
                "settings_sha256": settings_digest(provenance.settings),
                "metadata": canonical_json(metadata),
                "inputs": canonical_json(inputs),
                "seed_key": provenance.seed_key,
                "span": provenance.span or (),
                "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
                "wall_seconds": time.monotonic() - provenance.started,
                "digest": digest,
                "machine": runtime.machine(),
                "complete": 1,
            }
            names = dataset_names(file, temporary.stat().st_size)
            _set_attributes(file, {**attributes, "arrays": canonical_json(array_seals(file, names))})
            _set_attributes(file, {"seal": seal(file, names)})
    return digest


def _write_dataset(file: h5py.File, name: str, dataset: Dataset) -> None:
    options: dict[str, Any] = {}
    data = _fixed_length(dataset.data) if isinstance(dataset.data, list) else dataset.data
    if data.ndim != len(dataset.axes):
        raise ValueError(f"dataset {name!r}: {data.ndim} dimensions, but axes {dataset.axes}")
    if data.ndim and data.size:
        # With checksums, a flipped byte is an error, never a number.
        options.update(chunks=_chunk_shape(data), fletcher32=True)
        if data.dtype.kind == "S" or (data.ndim >= 2 and data.dtype == np.float32):
            options.update(shuffle=data.dtype.kind == "f", compression="gzip", compression_opts=1)
    node = file.create_dataset(name, data=data, **options)
    axes = _fixed_length(dataset.axes)
    _set_attributes(node, {"unit": dataset.unit, "axes": axes, "description": dataset.description})


def _set_attributes(node: h5py.HLObject, values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        node.attrs[name] = _fixed_length([value]).reshape(()) if isinstance(value, str) else value


def _fixed_length(texts: Sequence[str]) -> npt.NDArray[np.bytes_]:
    """Encode strings in UTF-8, padded to the longest."""
    if any("\0" in text for text in texts):
        raise ValueError("text with a zero byte, which ends text in HDF5")
    encoded = [text.encode() for text in texts]
    return np.array(encoded, dtype=h5py.string_dtype("utf-8", max([1, *map(len, encoded)])))


def _chunk_shape(data: npt.NDArray[Any]) -> tuple[int, ...]:
    """Return the chunks of whole rows along the first axis, about 1 MiB each."""
    row_bytes = max(1, data[:1].nbytes)
    rows = int(np.clip(2**20 // row_bytes, 1, data.shape[0]))
    return (rows, *data.shape[1:])
