"""Damaging artifacts, and the stages that read them, run in this process."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from warmlens.artifacts.chain import input_paths
from warmlens.artifacts.file import Provenance, open_artifact, write_artifact
from warmlens.campaign.files import stage_files
from warmlens.campaign.settings import STAGES, stage_settings
from warmlens.config.model import Config
from warmlens.report.result import print_result
from warmlens.stages import (
    deflections,
    halos,
    mocks,
    scan_operator,
    scans,
    smooth_model,
    summaries,
)
from warmlens.stages.abc import run as abc

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
assert READER.keys() == set(STAGES)


def artifact_of(config: Config, stage: str) -> Path:
    """The artifact of a stage that is damaged: of several the first."""
    return stage_files(config, stage)[0]


def run_stage(config: Config, stage: str, output: Path) -> None:
    """Do the work of a stage on the artifacts of the campaign, and write it to another place."""
    if stage == "result":
        print_result(Path(config.results))
        return
    settings: Any = stage_settings(config, stage)

    def at(name: str) -> Path:
        return artifact_of(config, name)

    shards = stage_files(config, "scan_operator")
    lens = (at("observation"), at("smooth_model"))
    operator = (at("scan_design"), shards, output)
    work: dict[str, Callable[[], None]] = {
        "halos": lambda: halos.run(settings, (0, 7), output),
        "null_mocks": lambda: mocks.run_null(settings, *lens, output),
        "smooth_model": lambda: smooth_model.run(settings, at("observation"), output),
        "scan_design": lambda: scan_operator.run_design(settings, *lens, output),
        "scan_operator": lambda: scan_operator.run(settings, (0, 5), *lens, at("scan_design"), output),
        "observed_scan": lambda: scans.run_observed(settings, *lens, *operator),
        "observed_summary": lambda: summaries.run_observed(settings, at("observed_scan"), output),
        "deflections": lambda: deflections.run(settings, at("halos"), at("observation"), output),
        "mocks": lambda: mocks.run(settings, at("deflections"), *lens, output),
        "scans": lambda: scans.run(settings, at("mocks"), *lens, *operator),
        "summaries": lambda: summaries.run(settings, at("scans"), output),
        "null_scans": lambda: scans.run(settings, at("null_mocks"), *lens, *operator),
        "null_summaries": lambda: summaries.run(settings, at("null_scans"), output),
        "abc": lambda: abc.run(
            settings,
            stage_files(config, "summaries"),
            at("observed_summary"),
            at("smooth_model"),
            output,
            output.with_suffix(".csv"),
            output.with_suffix(".json"),
            at("null_summaries"),
        ),
    }
    work[stage]()


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
