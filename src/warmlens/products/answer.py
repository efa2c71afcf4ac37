"""Files beside the artifact of an answer, made from it alone: its table as CSV and its numbers as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from warmlens.artifacts.file import Artifact
from warmlens.config.digest import canonical_json

NODE_COLUMNS = (
    *("m_th_kev", "log10_m_halo_msun", "n_samples", "n_accepted"),
    *("rate_low", "rate_high", "probability"),
)
_MAX_HEAD = 2**16  # bytes of the names of the columns
_MAX_JSON = 2**26


def answer_table(artifact: Artifact) -> pd.DataFrame:
    """Return the table of an open answer: one row per sample, or per node of a grid."""
    if artifact.stage == "exclusion":
        return _nodes(artifact)
    names = [name for name in artifact.names if name.startswith("table/")]
    return pd.DataFrame(
        {
            name.removeprefix("table/"): (
                artifact.strings(name) if artifact[name].dtype.kind == "S" else artifact.array(name)
            )
            for name in names
        }
    )


def _nodes(artifact: Artifact) -> pd.DataFrame:
    """Return one row per node, halo mass by halo mass."""
    halo, relic = artifact.array("nodes/log10_m_halo_msun"), artifact.array("nodes/m_th_kev")
    low, high = artifact.array("nodes/rate_interval").reshape(-1, 2).T
    counts = [artifact.array(f"nodes/{name}").ravel() for name in ("n_samples", "n_accepted")]
    probability = artifact.array("nodes/probability").ravel()
    columns = (np.tile(relic, len(halo)), halo.repeat(len(relic)), *counts, low, high, probability)
    return pd.DataFrame(dict(zip(NODE_COLUMNS, columns, strict=True)))


def table_text(artifact: Artifact, columns: Sequence[str]) -> bytes:
    """Return the CSV of an open answer, its columns in the order `columns`."""
    text: str = answer_table(artifact)[list(columns)].to_csv(index=False)
    return text.encode()


def answer_numbers(artifact: Artifact, metadata: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the content of the JSON of an open answer: what made it, its metadata, and the nodes of a grid.

    The artifact keeps its metadata in alphabetical order; `metadata` are the same in an order for people.
    """
    made_by = {"package_version": artifact.package_version}
    origin = {"artifact": artifact.path.name, "artifact_digest": artifact.digest}
    nodes = {"nodes": answer_table(artifact).to_dict(orient="records")} if artifact.stage == "exclusion" else {}
    return {**made_by, **origin, **(metadata or artifact.metadata), **nodes}


def is_answer_table(path: Path, artifact: Artifact) -> bool:
    """Return whether a CSV is that of an open answer, to the byte; the order of its columns is free."""
    with path.open("rb") as handle:
        columns = handle.readline(_MAX_HEAD).decode(errors="replace").rstrip("\r\n").split(",")
    if sorted(columns) != sorted(map(str, answer_table(artifact))):
        return False
    expected = table_text(artifact, columns)
    return path.stat().st_size == len(expected) and path.read_bytes() == expected


def is_answer_numbers(path: Path, artifact: Artifact) -> bool:
    """Return whether a JSON has the content of an open answer; its layout and the order of its keys are free."""
    if path.stat().st_size > _MAX_JSON:
        return False
    try:
        content = json.loads(path.read_bytes(), object_pairs_hook=_without_twins)
    except (ValueError, RecursionError):
        return False
    return isinstance(content, dict) and canonical_json(content) == canonical_json(answer_numbers(artifact))


def _without_twins(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """Refuse an object with a key twice, of which each reader may take another."""
    content = dict(pairs)
    if len(content) < len(pairs):
        raise ValueError("a key is given twice")
    return content
