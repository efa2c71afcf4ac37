"""Audit of a campaign: its artifacts, the files that were made from them, and files that do not belong to it."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from warmlens.artifacts.atomic import ArtifactError, file_digest
from warmlens.artifacts.chain import Finding, Record, examine
from warmlens.artifacts.names import CHUNKED, CRATE, MANIFEST, SINGLE
from warmlens.campaign.answer import settings_changes
from warmlens.campaign.derived import derived_files, derived_findings, ledgers
from warmlens.campaign.files import artifact_files
from warmlens.config.model import Config
from warmlens.products.manifest import Manifest, ManifestFile, read_manifest
from warmlens.stage_table import stage_digests

ManifestState = Literal["present", "none", "damaged"]


@dataclass(frozen=True)
class CampaignAudit:
    """Result of an audit: one record per artifact, and one per other file, with its kind in place of a stage.

    `manifest_findings` are about the manifest and the crate as a whole. Nothing is known about `unchecked` files:
    there is no manifest, and no ledger.
    """

    results: Path
    artifacts: tuple[Record, ...]
    files: tuple[Record, ...]
    manifest: ManifestState
    manifest_findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    unchecked: frozenset[Path] = frozenset()

    @property
    def findings(self) -> list[Finding]:
        """Everything that is wrong."""
        of_files = [finding for record in (*self.artifacts, *self.files) for finding in record.findings]
        return [*of_files, *self.manifest_findings]

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.findings


def audit_campaign(config: Config, done: Callable[[Path], None] = lambda _: None) -> CampaignAudit:
    """Re-hash all files in `config.results`, follow the chain of the artifacts, and compare with the manifest.

    Files that derive from artifacts are compared with these, whatever the manifest lists. `done` is called with
    the path of every file, from several threads.
    """
    results = Path(config.results)
    expected, derived = artifact_files(config), derived_files(config)
    records = [_name_settings(record, config) for record in examine(expected, stage_digests(config), done)]
    notes = _strays(results, expected)
    state, manifest = _read_state(results)
    if manifest is not None:
        listed = {results / each.path: each for each in manifest.files}
        records = [_compare_artifact(record, listed.get(record.path)) for record in records]
    digests = {record.path: record.header.digest for record in records if record.header}
    wrong = frozenset(record.path for record in records if record.findings)
    findings = derived_findings(config, digests, wrong)
    of_manifest = [finding for finding in findings if finding.path in (results / MANIFEST, results / CRATE)]
    unrecorded = _unrecorded(config, manifest)
    files = []
    for path, kind in derived.items():
        problems = tuple(finding for finding in findings if finding.path == path)
        if not path.exists() and state != "none" and not (unrecorded and kind == "record"):
            problems = (Finding(path, "missing", "missing"),)
        if problems or path.exists():
            files.append(Record(path, kind, findings=problems))
            done(path)
    if unrecorded:
        notes.append(
            f"{results}: no record of what figures and report were made from, as in earlier versions; "
            f"`warmlens resume {results}` makes them again, with records"
        )
    if state == "none":
        if n_absent := sum(not path.exists() for path in (*expected, *derived)):
            notes.append(f"{MANIFEST}: there is none, for the campaign is not finished ({n_absent} files to make)")
        else:
            of_manifest = [Finding(results / MANIFEST, "missing", "missing")]
    known = {"table"} if unrecorded else {"table", "figure", "report", "record"}
    unchecked = {file.path for file in files if state != "present" and file.stage not in known}
    return CampaignAudit(
        results, tuple(records), tuple(files), state, tuple(of_manifest), tuple(notes), frozenset(unchecked)
    )


def _read_state(results: Path) -> tuple[ManifestState, Manifest | None]:
    try:
        manifest = read_manifest(results)
    except ArtifactError:
        return "damaged", None
    return ("none" if manifest is None else "present"), manifest


def _unrecorded(config: Config, manifest: Manifest | None) -> bool:
    """Return whether figures and report are of an early version, which kept no record of their inputs."""
    kept = any(path.exists() for path in ledgers(config))
    listed = manifest is not None and any(each.kind == "record" for each in manifest.files)
    drawn = any(kind in ("figure", "report") and path.exists() for path, kind in derived_files(config).items())
    return drawn and not kept and not listed


def _compare_artifact(record: Record, listed: ManifestFile | None) -> Record:
    """Add to an artifact without fault that it cannot be the one that the manifest lists with these settings."""
    header = record.header
    if header is None or record.findings or listed is None or listed.settings_sha256 != header.settings_sha256:
        return record
    if header.digest != listed.digest:
        problem = f"its content is not what {MANIFEST} lists for the same settings"
    elif header.created_utc == listed.created_utc and file_digest(record.path) != listed.sha256:
        problem = f"its bytes are not what {MANIFEST} lists, though its content is"
    else:
        return record
    return dataclasses.replace(record, findings=(Finding(record.path, problem, "manifest"),))


def _name_settings(record: Record, config: Config) -> Record:
    """Add to a record with other settings than the campaign which of them differ."""
    if record.header is None or not any(finding.kind == "settings" for finding in record.findings):
        return record
    changes = settings_changes(config, record.header)
    findings = tuple(
        dataclasses.replace(finding, problem=f"{finding.problem}: {changes}")
        if finding.kind == "settings"
        else finding
        for finding in record.findings
    )
    return dataclasses.replace(record, findings=findings)


def _strays(results: Path, expected: Mapping[Path, str]) -> list[str]:
    """Name the HDF5 files among the artifacts that the campaign does not have, as chunks of another size."""
    folders = dict.fromkeys((results / name).parent for name in SINGLE.values())
    folders |= dict.fromkeys(results / stage for stage in CHUNKED)
    strays = [path for folder in folders for path in sorted(folder.glob("*.h5")) if path not in expected]
    return [
        f"{path}: no part of this campaign, and nothing reads it; `rm {shlex.quote(str(path))}` tidies up"
        for path in strays
    ]
