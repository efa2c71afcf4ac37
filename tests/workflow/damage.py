"""Damaging artifacts, and the stages that read them, run in this process."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from warmlens.artifacts.chain import input_paths
from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.campaign.files import chunks, stage_files, stage_inputs
from warmlens.config.model import Config
from warmlens.report.result import print_result
from warmlens.stage_table import STAGES, stage_settings
from warmlens.stages.job import make_job, run_job

READER = {  # a stage that reads the artifact of each
    "observation": "smooth_model",
    "smooth_model": "scan_design",
    "scan_design": "scan_operator",
    "scan_operator": "observed_scan",
    "observed_scan": "observed_summary",
    "observed_summary": "abc",
    "halos": "deflections",
    "deflections": "mocks",
    "mocks": "scans",
    "scans": "summaries",
    "summaries": "abc",
    "null_mocks": "null_scans",
    "null_scans": "null_summaries",
    "null_summaries": "abc",
    "abc": "result",
}
assert READER.keys() == STAGES.keys() - {"exclusion"}


def artifact_of(config: Config, stage: str) -> Path:
    """The artifact of a stage that is damaged: of several the first."""
    return stage_files(config, stage)[0]


def run_stage(config: Config, stage: str, output: Path) -> None:
    """Do the work of a stage on the artifacts of the campaign, and write it to another place."""
    if stage == "result":
        print_result(Path(config.results))
        return
    first = chunks(config)[0] if STAGES[stage].by_sample else None
    span = {"halos": (0, 7), "scan_operator": (0, 5)}.get(stage, first)
    inputs = stage_inputs(config, stage, first)
    run_job(make_job(stage, stage_settings(config, stage), output, inputs, span))


def flip(path: Path, place: int) -> None:
    """Flip a bit of a file; its time is kept, as when a disk errs."""
    content = bytearray(path.read_bytes())
    content[place] ^= 1 << (place % 8)
    rewrite(path, bytes(content))


def flip_arrays(path: Path) -> None:
    """Flip a bit in the middle of the first stored piece of every array."""
    with open_artifact(path) as artifact:
        arrays = [artifact.file[name] for name in artifact.names]
        pieces = [array.id.get_chunk_info(0) for array in arrays if array.chunks and array.size]
    for piece in pieces:
        flip(path, int(piece.byte_offset + piece.size // 2))


def flip_metadata(path: Path) -> None:
    """Flip the lowest bit of the last digit of the metadata: 2 becomes 3."""
    with open_artifact(path) as artifact:
        text = artifact.text("metadata").encode()
    digits = [i for i, byte in enumerate(text) if chr(byte).isdigit()]
    content = path.read_bytes()
    start = content.index(text)
    place = start + digits[-1] if digits else start + len(text) // 2
    rewrite(path, content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])


def rewrite_arrays(path: Path) -> None:
    """Write every array anew in place, its first number another; HDF5 renews its checksums."""
    times = path.stat()
    with h5py.File(path, "r+", locking=False) as file:
        for name in _arrays(file):
            data = file[name][...]
            data.flat[0] = data.flat[0] == 0
            file[name][...] = data
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def exchange_arrays(path: Path) -> None:
    """Exchange arrays of one shape and type, with their attributes: those of two bands, where there are bands."""
    times = path.stat()
    with h5py.File(path, "r+", locking=False) as file:
        alike: dict[tuple[object, ...], list[str]] = {}
        for name in _arrays(file):
            alike.setdefault((file[name].shape, file[name].dtype), []).append(name)
        for names in alike.values():
            for first, second in zip(names[::2], names[1::2], strict=False):
                file.move(first, "aside")
                file.move(second, first)
                file.move("aside", second)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def _arrays(file: h5py.File) -> list[str]:
    names: list[str] = []
    file.visititems(lambda name, node: names.append(name) if isinstance(node, h5py.Dataset) else None)
    numbers = [name for name in names if file[name].dtype.kind != "S" and file[name].size > 1]
    return sorted(numbers, key=lambda name: name.rpartition("/")[2])  # bands beside each other


def truncate(path: Path) -> None:
    """Cut a file in half."""
    content = path.read_bytes()
    rewrite(path, content[: len(content) // 2])


def rewrite(path: Path, content: bytes) -> None:
    """Other bytes in a file, its time kept."""
    stat = path.stat()
    path.write_bytes(content)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def swap(path: Path, other: Path) -> None:
    """Exchange two files; their times go with them."""
    aside = path.with_name("aside")
    path.rename(aside)
    other.rename(path)
    aside.rename(other)


def places(path: Path, n: int) -> list[int]:
    """n places spread over a file, the same every time."""
    return sorted(np.random.default_rng(8).choice(path.stat().st_size, n, replace=False).tolist())


def with_settings(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """The same artifact as made with other settings: sound, and of the same content."""
    _write_anew(path, change, lambda _: None)


def with_other_content(path: Path) -> None:
    """A sound artifact with the same settings, but of other content."""
    _write_anew(path, lambda _: None, lambda metadata: metadata.update(note="another"))


def _write_anew(
    path: Path, change: Callable[[dict[str, Any]], None], describe: Callable[[dict[str, Any]], None]
) -> None:
    with open_artifact(path) as artifact:
        settings, metadata = dict(artifact.settings), dict(artifact.metadata)
        change(settings)
        describe(metadata)
        datasets = {name: artifact.dataset(name) for name in artifact.names}
        provenance = Provenance(artifact.stage, settings, input_paths(artifact, path), span=artifact.span)
    write_artifact(path, provenance, datasets, metadata)


def restore(path: Path, original: Path) -> None:
    """Put an artifact back as it was."""
    shutil.copy2(original, path)
