"""Audit of a whole campaign: its artifacts, the files that were made of them, and what does not belong to it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from warmlens.artifacts.chain import Finding, Record, examine
from warmlens.artifacts.file import ArtifactError, file_digest
from warmlens.artifacts.names import CHUNKED, MANIFEST, SINGLE
from warmlens.audit.manifest import ManifestFile, artifact_files, derived_files, read_manifest
from warmlens.config.model import Config
from warmlens.stage_table import stage_digests, stage_settings

_NONE = "none"
_SHOWN = 3  # settings that differ, by name


@dataclass(frozen=True)
class FileRecord:
    """A file that is no artifact, whether there is a manifest to compare it with, and what is wrong with it."""

    path: Path
    kind: str
    checked: bool
    findings: tuple[Finding, ...] = ()

    @property
    def verdict(self) -> str:
        """ "ok", "unchecked", or what is wrong."""
        if self.findings:
            return self.findings[0].kind
        return "ok" if self.checked else "unchecked"


@dataclass(frozen=True)
class CampaignAudit:
    """What an audit found.

    Attributes
    ----------
    results
        Results folder.
    artifacts, files
        One entry an artifact, and one a file that was made of them.
    manifest
        Whether there is one that can be read.
    manifest_findings
        What is wrong with the manifest as a whole.
    notes
        What is worth knowing and no error.
    """

    results: Path
    artifacts: tuple[Record, ...]
    files: tuple[FileRecord, ...]
    manifest: Literal["present", "none", "damaged"]
    manifest_findings: tuple[Finding, ...]
    notes: tuple[str, ...]

    @property
    def findings(self) -> list[Finding]:
        """Everything that is wrong."""
        of_artifacts = [finding for record in self.artifacts for finding in record.findings]
        of_files = [finding for item in self.files for finding in item.findings]
        return [*of_artifacts, *of_files, *self.manifest_findings]

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.findings


def audit_campaign(config: Config, done: Callable[[Path], None] = lambda _: None) -> CampaignAudit:
    """Re-hash all files of a campaign, follow the chain of its artifacts, and compare with its manifest.

    Parameters
    ----------
    config
        Of the campaign; its files are looked for in `config.results`.
    done
        Told of every file, from several threads.
    """
    results = Path(config.results)
    expected, derived = artifact_files(config), derived_files(config)
    records = [_explained(record, config) for record in examine(expected, stage_digests(config), done)]
    notes = list(_strays(results, expected))
    unchecked = tuple(FileRecord(path, kind, checked=False) for path, kind in derived.items() if path.exists())
    try:
        manifest = read_manifest(results)
    except ArtifactError as error:
        wrong: tuple[Finding, ...] = (Finding(results / MANIFEST, f"damaged: {error}", "damaged"),)
        return CampaignAudit(results, tuple(records), unchecked, "damaged", wrong, tuple(notes))
    if manifest is None:
        n_absent = sum(not path.exists() for path in (*expected, *derived))
        remedy = f"missing; write it with: warmlens manifest {results}"
        wrong = () if n_absent else (Finding(results / MANIFEST, remedy, "missing"),)
        if n_absent:
            notes.append(f"{MANIFEST}: there is none, for the campaign is not finished ({n_absent} files to make)")
        return CampaignAudit(results, tuple(records), unchecked, "none", wrong, tuple(notes))
    listed = {results / item.path: item for item in manifest.files}
    wrong = tuple(
        Finding(path, f"in {MANIFEST}, but no part of this campaign; {_remedy(results)}", "manifest")
        for path in listed
        if path not in expected and path not in derived
    )
    return CampaignAudit(
        results,
        tuple(_compared(record, listed.get(record.path), results) for record in records),
        tuple(_check_file(path, kind, listed.get(path), results, done) for path, kind in derived.items()),
        "present",
        wrong,
        tuple(notes),
    )


def _remedy(results: Path) -> str:
    return f"if the change was meant: warmlens manifest {results}"


def _compared(record: Record, listed: ManifestFile | None, results: Path) -> Record:
    """The record with what the manifest says against it."""
    if record.header is None or (listed is not None and listed.digest == record.header.digest):
        return record
    problem = f"not in {MANIFEST}" if listed is None else f"not what {MANIFEST} lists"
    finding = Finding(record.path, f"{problem}; {_remedy(results)}", "manifest")
    return dataclasses.replace(record, findings=(*record.findings, finding))


def _check_file(
    path: Path, kind: str, listed: ManifestFile | None, results: Path, done: Callable[[Path], None]
) -> FileRecord:
    if not path.is_file():
        return FileRecord(path, kind, checked=True, findings=(Finding(path, "missing", "missing"),))
    problem = ""
    if listed is None:
        problem = f"not in {MANIFEST}"
    elif path.stat().st_size != listed.size or file_digest(path) != listed.sha256:
        problem = f"not what {MANIFEST} lists"
    done(path)
    found = (Finding(path, f"{problem}; {_remedy(results)}", "manifest"),) if problem else ()
    return FileRecord(path, kind, checked=True, findings=found)


def _explained(record: Record, config: Config) -> Record:
    """The record with the settings by name that are no longer those of the campaign."""
    if record.header is None or not any(finding.kind == "settings" for finding in record.findings):
        return record
    current = stage_settings(config, record.header.stage).as_dict()
    told = differences(record.header.settings, current)
    findings = tuple(
        dataclasses.replace(item, problem=f"{item.problem}: {told}") if item.kind == "settings" else item
        for item in record.findings
    )
    return dataclasses.replace(record, findings=findings)


def differences(recorded: Mapping[str, Any], current: Mapping[str, Any]) -> str:
    """Which settings differ, in words: the version of the stage's code first, then keys with both values."""
    before, now = dict(_leaves(recorded)), dict(_leaves(current))
    keys = [key for key in {**before, **now} if before.get(key, _NONE) != now.get(key, _NONE)]
    keys.sort(key=lambda key: key != "stage_version")
    parts = [_difference(key, before.get(key, _NONE), now.get(key, _NONE)) for key in keys[:_SHOWN]]
    return ", ".join(parts) + (f" and {len(keys) - _SHOWN} more" if len(keys) > _SHOWN else "")


def _difference(key: str, before: Any, now: Any) -> str:
    if key.startswith("upstream."):
        return f"the settings of {key.removeprefix('upstream.')} have changed"
    name = "version of the stage's code" if key == "stage_version" else key
    return f"{name} was {before}, is now {now}"


def _leaves(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _strays(results: Path, expected: Mapping[Path, str]) -> Iterator[str]:
    """HDF5 files where artifacts lie that the campaign does not have: other chunks, samples beyond its end."""
    folders = dict.fromkeys([results, *(results / name for name in CHUNKED)])
    folders |= dict.fromkeys((results / name).parent for name in SINGLE.values())
    for folder in folders:
        for path in sorted(folder.glob("*.h5")):
            if path not in expected:
                yield f"{path}: no part of this campaign"
