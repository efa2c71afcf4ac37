"""What is in `manifest.json`: every file of a finished campaign with its size and SHA-256, and what made it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.names import MANIFEST
from warmlens.products.ledger import Listing, RelativePath, read_limited, reason

Kind = Literal["artifact", "configuration", "table", "figure", "report", "record"]


class ManifestFile(Listing):
    """One file: its path under the results folder; of an artifact also what its header states."""

    path: RelativePath
    kind: Kind
    size: int
    sha256: str
    stage: str | None = None
    digest: str | None = None
    settings_sha256: str | None = None
    git_commit: str | None = None
    created_utc: str | None = None
    machine: str | None = None


class Manifest(Listing):
    """All files of a campaign, and the versions of the program that wrote the list."""

    format: Literal["warmlens/manifest"] = "warmlens/manifest"
    format_version: Literal[1] = 1
    created_utc: str
    package_version: str
    git_commit: str
    git_dirty: bool
    python: str
    libraries: dict[str, str]
    seed: int
    config: dict[str, Any]
    files: list[ManifestFile]


def read_manifest(results: Path) -> Manifest | None:
    """Read the manifest of a results folder; None if there is none, `ArtifactError` if the file is damaged."""
    path = results / MANIFEST
    if not path.is_file():
        return None
    try:
        return Manifest.model_validate_json(read_limited(path))
    except (OSError, ValueError) as error:
        raise ArtifactError(
            f"{path}: no manifest ({reason(error)}); write one: warmlens manifest {results}"
        ) from error
