"""Writing `manifest.json`: every file of a finished campaign with its size and SHA-256, and what made it."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from warmlens import __version__
from warmlens.artifacts.atomic import ArtifactError, atomic_path, file_digest
from warmlens.artifacts.chain import walk
from warmlens.artifacts.code_version import code_commit
from warmlens.artifacts.file import Header
from warmlens.artifacts.names import CONFIG, SINGLE
from warmlens.campaign.derived import derived_files
from warmlens.campaign.files import artifact_files
from warmlens.campaign.snakemake import remaking_command
from warmlens.config.model import Config
from warmlens.products.manifest import Manifest, ManifestFile
from warmlens.stage_table import campaign_stages, stage_digests

LIBRARIES = ("astropy", "colossus", "h5py", "lenstronomy", "numba", "numpy", "pandas", "scipy", "snakemake")
_OF_ARTIFACT = ("stage", "digest", "settings_sha256", "git_commit", "created_utc", "machine")  # of its header


def make_manifest(config: Config, done: Callable[[Path], None] = lambda _: None) -> tuple[Manifest, list[Header]]:
    """Hash every file of a finished campaign in `config.results`; `done` is called with the path of each.

    Returns
    -------
    manifest, headers
        All files, artifacts first, and the headers of the artifacts in the same order.

    Raises
    ------
    ArtifactError
        If a file is missing, or the chain of artifacts is broken.
    """
    root = Path(config.results)
    artifacts, derived = artifact_files(config), derived_files(config)
    missing = [path for path in (*artifacts, *derived) if not path.exists()]
    if missing:
        raise ArtifactError(
            f"{missing[0]}: no such file ({len(missing)} of the campaign missing); a manifest needs a finished "
            f"campaign, run it first: {remaking_command(root)}"
        )
    answer = root / SINGLE[campaign_stages(config)[-1]]
    records = walk(artifacts, stage_digests(config), hashed=[answer])
    headers = [record.sound_header() for record in records][: len(artifacts)]
    files = []
    for header in headers:
        stated = {name: getattr(header, name) for name in _OF_ARTIFACT}
        files.append(ManifestFile(**_bytes(header.path, root), kind="artifact", **stated))
        done(header.path)
    for path, kind in derived.items():
        files.append(ManifestFile(**_bytes(path, root), kind=kind))
        done(path)
    commit, dirty = code_commit()
    manifest = Manifest(
        created_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        package_version=__version__,
        git_commit=commit,
        git_dirty=dirty,
        python=platform.python_version(),
        libraries={name: metadata.version(name) for name in LIBRARIES},
        seed=config.campaign.seed,
        config=json.loads((root / CONFIG).read_text(encoding="utf-8")),
        files=files,
    )
    return manifest, headers


def _bytes(path: Path, root: Path) -> dict[str, Any]:
    return {"path": path.relative_to(root).as_posix(), "size": path.stat().st_size, "sha256": file_digest(path)}


def write_manifest(manifest: Manifest, path: Path) -> None:
    """Write a manifest as JSON, without what is None."""
    with atomic_path(path) as temporary:
        temporary.write_text(manifest.model_dump_json(indent=2, exclude_none=True) + "\n", encoding="utf-8")
