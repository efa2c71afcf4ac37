"""Audit of a campaign: its artifacts, the files that were made from them, and files that do not belong to it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from warmlens.artifacts.chain import Finding, Record, examine
from warmlens.artifacts.file import ArtifactError, file_digest
from warmlens.artifacts.names import CHUNKED, MANIFEST, SINGLE
from warmlens.audit.manifest import ManifestFile, derived_files, read_manifest
from warmlens.campaign.files import artifact_files
from warmlens.campaign.start import differences
from warmlens.config.model import Config
from warmlens.stage_table import stage_digests, stage_settings

ManifestState = Literal["present", "none", "damaged"]


@dataclass(frozen=True)
class CampaignAudit:
    """Result of an audit: one record per artifact, and one per other file, with its kind in place of a stage.

    Other files are compared with the manifest, if it is present; `manifest_findings` are about it as a whole.
    """

    results: Path
    artifacts: tuple[Record, ...]
    files: tuple[Record, ...]
    manifest: ManifestState
    manifest_findings: tuple[Finding, ...]
    notes: tuple[str, ...]

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

    `done` is called with the path of every file, from several threads.
    """
    results = Path(config.results)
    expected, derived = artifact_files(config), derived_files(config)
    records = [_name_settings(record, config) for record in examine(expected, stage_digests(config), done)]
    files = [Record(path, kind) for path, kind in derived.items() if path.exists()]
    notes = _strays(results, expected)
    manifest = None
    state: ManifestState = "none"
    wrong: list[Finding] = []
    try:
        manifest = read_manifest(results)
    except ArtifactError as error:
        state, wrong = "damaged", [Finding(results / MANIFEST, f"damaged: {error}", "damaged")]
    if manifest is not None:
        state = "present"
        listed = {results / each.path: each for each in manifest.files}
        records = [_compare_artifact(record, listed.get(record.path), results) for record in records]
        files = [_compare_file(path, kind, listed.get(path), results, done) for path, kind in derived.items()]
        problem = f"in {MANIFEST}, but no part of this campaign"
        strangers = [path for path in listed if path not in expected and path not in derived]
        wrong = [_manifest_finding(path, problem, results) for path in strangers]
    elif state == "none" and (n_absent := sum(not path.exists() for path in (*expected, *derived))):
        notes.append(f"{MANIFEST}: there is none, for the campaign is not finished ({n_absent} files to make)")
    elif state == "none":
        remedy = f"missing; write it with: warmlens manifest {results}"
        wrong = [Finding(results / MANIFEST, remedy, "missing")]
    return CampaignAudit(results, tuple(records), tuple(files), state, tuple(wrong), tuple(notes))


def _manifest_finding(path: Path, problem: str, results: Path) -> Finding:
    return Finding(path, f"{problem}; if the change was meant: warmlens manifest {results}", "manifest")


def _compare_artifact(record: Record, listed: ManifestFile | None, results: Path) -> Record:
    """Add to a record that the manifest has another artifact."""
    if record.header is None or (listed is not None and listed.digest == record.header.digest):
        return record
    problem = f"not in {MANIFEST}" if listed is None else f"not what {MANIFEST} lists"
    finding = _manifest_finding(record.path, problem, results)
    return dataclasses.replace(record, findings=(*record.findings, finding))


def _compare_file(
    path: Path, kind: str, listed: ManifestFile | None, results: Path, done: Callable[[Path], None]
) -> Record:
    if not path.is_file():
        return Record(path, kind, findings=(Finding(path, "missing", "missing"),))
    problem = ""
    if listed is None:
        problem = f"not in {MANIFEST}"
    elif path.stat().st_size != listed.size or file_digest(path) != listed.sha256:
        problem = f"not what {MANIFEST} lists"
    done(path)
    return Record(path, kind, findings=(_manifest_finding(path, problem, results),) if problem else ())


def _name_settings(record: Record, config: Config) -> Record:
    """Add to a record with other settings than the campaign which of them differ."""
    if record.header is None or not any(finding.kind == "settings" for finding in record.findings):
        return record
    current = stage_settings(config, record.header.stage).as_dict()
    changes = differences(record.header.settings, current)
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
    return [f"{path}: no part of this campaign" for path in strays]
