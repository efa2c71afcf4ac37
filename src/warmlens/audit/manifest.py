"""`manifest.json`: every file of a finished campaign with its size and SHA-256, and what made it."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError

from warmlens import __version__
from warmlens.artifacts.chain import walk
from warmlens.artifacts.code_version import code_commit
from warmlens.artifacts.file import ArtifactError, Header, atomic_path, file_digest
from warmlens.artifacts.names import ANSWER_FILES, CONFIG, MANIFEST, REPORT, SINGLE
from warmlens.campaign.files import artifact_files
from warmlens.campaign.snakemake import remaking_command
from warmlens.config.model import Config
from warmlens.figures.inputs import drawn_figures
from warmlens.stage_table import campaign_stages, stage_digests

LIBRARIES = ("astropy", "colossus", "h5py", "lenstronomy", "numba", "numpy", "pandas", "scipy", "snakemake")
_MAX_BYTES = 2**26
_OF_ARTIFACT = ("stage", "digest", "settings_sha256", "git_commit", "created_utc", "machine")  # of its header

Kind = Literal["artifact", "configuration", "table", "figure", "report"]


def _relative(name: str) -> str:
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or str(path) != name:
        raise ValueError(f"{name!r} is no plain path below the results folder")
    return name


class _Plain(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="strings")


class ManifestFile(_Plain):
    """One file: its path under the results folder; of an artifact also what its header states."""

    path: Annotated[str, AfterValidator(_relative)]
    kind: Kind
    size: int
    sha256: str
    stage: str | None = None
    digest: str | None = None
    settings_sha256: str | None = None
    git_commit: str | None = None
    created_utc: str | None = None
    machine: str | None = None


class Manifest(_Plain):
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


def derived_files(config: Config) -> dict[Path, Kind]:
    """Return the files of a finished campaign that are no artifacts, with their kinds."""
    root = Path(config.results)
    answer = campaign_stages(config)[-1]
    files: dict[Path, Kind] = {root / CONFIG: "configuration"}
    files |= dict.fromkeys((root / name for name in ANSWER_FILES[answer]), "table")
    for name in drawn_figures(config):
        files |= dict.fromkeys((root / f"figures/{name}.{kind}" for kind in ("png", "csv")), "figure")
    if answer == "abc":
        files[root / REPORT] = "report"
    return files


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


def read_manifest(results: Path) -> Manifest | None:
    """Read the manifest of a results folder; None if there is none, `ArtifactError` if the file is damaged."""
    path = results / MANIFEST
    if not path.is_file():
        return None
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ValueError(f"it has more than {_MAX_BYTES} bytes")
        return Manifest.model_validate_json(path.read_bytes())
    except (OSError, ValueError) as error:
        where = error.errors()[0] if isinstance(error, ValidationError) else None
        reason = f"{'.'.join(map(str, where['loc']))}: {where['msg']}" if where else str(error)
        raise ArtifactError(f"{path}: no manifest ({reason}); write one: warmlens manifest {results}") from error
