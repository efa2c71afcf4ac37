"""Walking the chain of artifacts: from the posterior back to the observation."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from warmlens.artifacts import (
    Artifact,
    ArtifactError,
    content_digest,
    input_digest,
    open_artifact,
    reading,
    settings_digest,
)
from warmlens.config_observation import FITS_FILES
from warmlens.layout import results_folder

_REMEDY = "delete it and run the campaign again"


@dataclass(frozen=True)
class Finding:
    """Something wrong with one artifact."""

    path: Path
    problem: str


def check_chain(path: Path, expected: Mapping[str, str]) -> None:
    """Check that an artifact and all it was made from had the expected settings and are unchanged since.

    Only attributes are read; `audit` hashes the contents too.

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
    seen: set[Path] = set()
    pending = [path]
    while pending:
        current = pending.pop().resolve()
        if current in seen or current.suffix != ".h5":
            continue
        seen.add(current)
        findings = _check_settings(current, expected) + _check_inputs(current)
        if findings:
            first = findings[0]
            raise ArtifactError(f"{first.path}: {first.problem}; {_REMEDY}")
        with open_artifact(current) as artifact:
            if artifact.stage != "observation":  # what that is made from belongs to another campaign
                pending += input_paths(artifact, current).values()


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
    findings: list[Finding] = []
    for path, stage in expected_files.items():
        if not path.exists():
            findings.append(Finding(path, "missing"))
            continue
        try:
            problems = _check_content(path, stage)
            problems += _check_settings(path, expected_settings) + _check_inputs(path)
        except (ArtifactError, OSError) as error:
            problems = [Finding(path, f"damaged: {error}")]
        findings += problems
    return findings


def _check_content(path: Path, stage: str) -> list[Finding]:
    with open_artifact(path, stage) as artifact, reading(path):
        if content_digest(artifact.file, artifact.metadata) != artifact.digest:
            return [Finding(path, "altered: its content does not match its digest")]
    return []


def _check_settings(path: Path, expected: Mapping[str, str]) -> list[Finding]:
    with open_artifact(path) as artifact:
        wanted = expected.get(artifact.stage)
        if wanted is not None and settings_digest(artifact.settings) != wanted:
            return [Finding(path, "made with other settings or an older version of its stage")]
    return []


def _check_inputs(path: Path) -> list[Finding]:
    findings = []
    with open_artifact(path) as artifact:
        for name, source in input_paths(artifact, path).items():
            recorded = artifact.inputs[name]
            if not os.path.exists(source):  # noqa: PTH110 (a path that the system refuses is no file either)
                findings.append(Finding(path, f"its input {name} ({recorded['path']}) is missing"))
            elif input_digest(source) != recorded["digest"]:
                findings.append(Finding(path, f"its input {name} ({recorded['path']}) has changed since"))
    return findings
