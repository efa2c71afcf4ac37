"""`derived/NAME.json`: what a figure or the report was made from, and the files that were made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError

from warmlens import __version__
from warmlens.artifacts.atomic import ArtifactError, atomic_path, file_digest
from warmlens.artifacts.code_version import code_commit
from warmlens.artifacts.file import input_digest

_MAX_BYTES = 2**26


def plain_path(name: str) -> str:
    """Return a path below the results folder; `ValueError` for one that leads elsewhere."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or str(path) != name:
        raise ValueError(f"{name!r} is no plain path below the results folder")
    return name


RelativePath = Annotated[str, AfterValidator(plain_path)]


class Listing(BaseModel):
    """A JSON file that lists files of a results folder."""

    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="strings")


class Ledger(Listing):
    """What one figure, or the report, was made from.

    `inputs` has the digest of the content of every artifact, and of the bytes of every other file; `outputs` has
    the SHA-256 of every file that was made. `version` is that of the code of all figures, or of the report.
    """

    format: Literal["warmlens/derived"] = "warmlens/derived"
    format_version: Literal[1] = 1
    created_utc: str
    package_version: str
    git_commit: str
    git_dirty: bool
    version: int
    inputs: dict[RelativePath, str]
    outputs: dict[RelativePath, str]


def write_ledger(
    path: Path, results: Path, version: int, inputs: Mapping[Path, str] | Sequence[Path], outputs: Sequence[Path]
) -> None:
    """Record that `outputs` were made from `inputs` under `results`; with their digests, if these are known."""
    digests = inputs if isinstance(inputs, Mapping) else {source: input_digest(source) for source in inputs}
    commit, dirty = code_commit()
    ledger = Ledger(
        created_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        package_version=__version__,
        git_commit=commit,
        git_dirty=dirty,
        version=version,
        inputs={source.relative_to(results).as_posix(): digest for source, digest in digests.items()},
        outputs={output.relative_to(results).as_posix(): file_digest(output) for output in outputs},
    )
    with atomic_path(path) as temporary:
        temporary.write_text(ledger.model_dump_json(indent=2) + "\n", encoding="utf-8")


def read_ledger(path: Path) -> Ledger:
    """Read a ledger; `ArtifactError` if it is none."""
    try:
        return Ledger.model_validate_json(read_limited(path))
    except (OSError, ValueError) as error:
        raise ArtifactError(f"{path}: no record of what was made from what ({reason(error)})") from error


def read_limited(path: Path) -> bytes:
    """Read a file of at most 64 MiB."""
    if path.stat().st_size > _MAX_BYTES:
        raise ValueError(f"it has more than {_MAX_BYTES} bytes")
    return path.read_bytes()


def reason(error: Exception) -> str:
    """Return in one line why a listing cannot be read."""
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    return str(error)
