"""Walking the chain of artifacts: from the posterior back to the observation."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from warmlens.artifacts.file import (
    SCHEMA_VERSION,
    Artifact,
    ArtifactError,
    content_digest,
    input_digest,
    open_artifact,
    reading,
)
from warmlens.artifacts.names import results_folder
from warmlens.config.digest import settings_digest
from warmlens.config.observation import FITS_FILES

Verdict = Literal["ok", "missing", "damaged", "altered", "settings", "inputs", "manifest"]

_REMEDY = "delete it and run the campaign again"
_THREADS = 2  # HDF5 reads one dataset at a time; the other thread hashes meanwhile


@dataclass(frozen=True)
class Finding:
    """Something wrong with one artifact, or another file of a campaign."""

    path: Path
    problem: str
    kind: Verdict


@dataclass(frozen=True)
class Header:
    """What an artifact says of itself: its attributes, without the contents.

    Attributes
    ----------
    stage, schema, schema_version
        What it holds, and how.
    digest, settings
        SHA-256 of its content, and what it was made with.
    inputs
        Of every input by name: its path as recorded, where that is, and the digest that it had.
    package_version, git_commit, git_dirty
        The code that made it.
    created_utc, wall_seconds
        When it was written, and how long it took.
    """

    stage: str
    schema: str
    schema_version: int
    digest: str
    settings: dict[str, Any]
    inputs: dict[str, tuple[str, Path, str]]
    package_version: str
    git_commit: str
    git_dirty: bool
    created_utc: str
    wall_seconds: float

    @property
    def settings_sha256(self) -> str:
        """SHA-256 of the settings."""
        return settings_digest(self.settings)


@dataclass(frozen=True)
class Record:
    """What an audit found of one artifact; no header if it is missing or cannot be read."""

    path: Path
    stage: str
    header: Header | None = None
    findings: tuple[Finding, ...] = field(default=())

    @property
    def verdict(self) -> Verdict:
        """What is wrong first of all; "ok" if nothing is."""
        return self.findings[0].kind if self.findings else "ok"


def read_header(artifact: Artifact, place: Path) -> Header:
    """Attributes of an open artifact that lies at `place`.

    Raises
    ------
    ArtifactError
        If an input is no artifact of the same results folder.
    """
    sources = input_paths(artifact, place)
    return Header(
        stage=artifact.stage,
        schema=artifact.text("schema"),
        schema_version=SCHEMA_VERSION,  # no other is opened
        digest=artifact.digest,
        settings=artifact.settings,
        inputs={name: (item["path"], sources[name], item["digest"]) for name, item in artifact.inputs.items()},
        package_version=artifact.text("package_version"),
        git_commit=artifact.text("git_commit"),
        git_dirty=artifact.git_dirty,
        created_utc=artifact.text("created_utc"),
        wall_seconds=artifact.wall_seconds,
    )


def check_chain(path: Path, expected: Mapping[str, str]) -> None:
    """Check that an artifact and all it was made from had the expected settings and are unchanged since.

    Of the artifact itself the content is hashed too, of those that it was made from `audit` does that.

    Parameters
    ----------
    path
        The last artifact of the chain.
    expected
        Digest of the settings of every stage.

    Raises
    ------
    ArtifactError
        Naming the first artifact that does not fit, and what to do.
    """
    check_chains([path], expected)


def check_chains(paths: Iterable[Path], expected: Mapping[str, str]) -> None:
    """Check several artifacts as `check_chain` does; what they have in common is read once."""
    headers: dict[Path, Header] = {}
    given = [path.resolve() for path in paths if path.suffix == ".h5"]
    for path in given:
        with open_artifact(path) as artifact, reading(path):
            altered = _check_content(artifact)
        if altered:
            raise ArtifactError(f"{path}: {altered[0].problem}; {_REMEDY}")
    seen: set[Path] = set()
    pending = given[::-1]
    while pending:
        current = pending.pop()
        if current in seen:
            continue
        seen.add(current)
        header = _header(current, headers)
        findings = [*_check_settings(current, header, expected), *_check_inputs(current, header, headers)]
        if findings:
            first = findings[0]
            raise ArtifactError(f"{first.path}: {first.problem}; {_REMEDY}")
        if header.stage != "observation":  # what that is made from belongs to another campaign
            pending += [source.resolve() for _, source, _ in header.inputs.values() if source.suffix == ".h5"]


def _header(path: Path, known: dict[Path, Header]) -> Header:
    if path not in known:
        with open_artifact(path) as artifact:
            known[path] = read_header(artifact, path)
    return known[path]


def input_paths(artifact: Artifact, place: Path) -> dict[str, Path]:
    """Where the inputs of an artifact are, by name, if it lies at `place`.

    Inputs are artifacts of the same results folder. Only an observation is made from files of the user, or from
    the observation of another campaign, which may be anywhere.

    Raises
    ------
    ArtifactError
        If an input, its symbolic links followed, is anything else.
    """
    allowed = (*FITS_FILES, "artifact")
    if artifact.stage == "observation" and any(name.rpartition("/")[2] not in allowed for name in artifact.inputs):
        raise ArtifactError(f"{artifact.path}: an observation is not made from {[*artifact.inputs]}; {_REMEDY}")
    # normalised, for the folder of `place` may not be there yet
    sources = {name: Path(os.path.normpath(place.parent / item["path"])) for name, item in artifact.inputs.items()}
    if artifact.stage == "observation":
        return sources
    folder = results_folder(place.absolute(), artifact.stage).resolve()
    for name, source in sources.items():
        with reading(artifact.path, f"the path of its input {name}"):
            inside = source.suffix == ".h5" and source.resolve().is_relative_to(folder)
        if not inside:
            raise ArtifactError(
                f"{artifact.path}: its input {name} ({artifact.inputs[name]['path']}) is no artifact of the "
                f"results folder {folder}; {_REMEDY}"
            )
    return sources


def audit(expected_files: Mapping[Path, str], expected_settings: Mapping[str, str]) -> list[Finding]:
    """Re-hash every artifact and follow every link.

    Parameters
    ----------
    expected_files
        Every artifact of the campaign and its stage.
    expected_settings
        Digest of the settings of every stage under the campaign's configuration.

    Returns
    -------
    list of Finding
        Every artifact that is missing, damaged, altered, made with other settings or code, or made from an
        input that has since changed; empty if all is well.
    """
    return [finding for record in examine(expected_files, expected_settings) for finding in record.findings]


def examine(
    expected_files: Mapping[Path, str],
    expected_settings: Mapping[str, str],
    done: Callable[[Path], None] = lambda _: None,
) -> list[Record]:
    """What `audit` finds, artifact by artifact, in the order of `expected_files`; each is told to `done`."""
    headers: dict[Path, Header] = {}

    def one(item: tuple[Path, str]) -> Record:
        record = _examine(*item, expected_settings, headers)
        done(item[0])
        return record

    with ThreadPoolExecutor(_THREADS) as pool:
        return list(pool.map(one, expected_files.items()))


def _examine(path: Path, stage: str, expected: Mapping[str, str], known: dict[Path, Header]) -> Record:
    if not path.exists():
        return Record(path, stage, None, (Finding(path, "missing", "missing"),))
    header = None
    findings: list[Finding] = []
    try:
        with open_artifact(path, stage) as artifact, reading(path):
            header = read_header(artifact, path)
            findings += _check_content(artifact)
    except (ArtifactError, OSError) as error:
        return Record(path, stage, header, (Finding(path, f"damaged: {error}", "damaged"),))
    findings += _check_settings(path, header, expected)
    try:
        findings += _check_inputs(path, header, known)
    except (ArtifactError, OSError) as error:
        findings.append(Finding(path, f"an input cannot be read: {error}", "inputs"))
    return Record(path, stage, header, tuple(findings))


def _check_content(artifact: Artifact) -> list[Finding]:
    if content_digest(artifact.file, artifact.metadata) != artifact.digest:
        return [Finding(artifact.path, "altered: its content does not match its digest", "altered")]
    return []


def _check_settings(path: Path, header: Header, expected: Mapping[str, str]) -> list[Finding]:
    wanted = expected.get(header.stage)
    if wanted is not None and header.settings_sha256 != wanted:
        return [Finding(path, "made with other settings or an older version of its stage", "settings")]
    return []


def _check_inputs(path: Path, header: Header, known: dict[Path, Header]) -> list[Finding]:
    findings = []
    for name, (recorded, source, digest) in header.inputs.items():
        if not os.path.exists(source):  # noqa: PTH110 (a path that the system refuses is no file either)
            findings.append(Finding(path, f"its input {name} ({recorded}) is missing", "inputs"))
        elif _digest(source, header, known) != digest:
            findings.append(Finding(path, f"its input {name} ({recorded}) has changed since", "inputs"))
    return findings


def _digest(source: Path, of: Header, known: dict[Path, Header]) -> str:
    if of.stage == "observation":  # made from files of the user
        return input_digest(source)
    return _header(source.resolve(), known).digest
