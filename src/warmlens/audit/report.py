"""An audit as a table to read, and as JSON for scripts."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from warmlens.artifacts.chain import Finding, Record
from warmlens.audit.campaign import CampaignAudit
from warmlens.text import duration

_DAY = 86400.0
_WIDEST = 400
_CHAIN = ("settings", "inputs")
_ATTRIBUTES = (
    "schema",
    "schema_version",
    "digest",
    "settings_sha256",
    "created_utc",
    "wall_seconds",
    "package_version",
    "git_commit",
    "git_dirty",
)


def print_audit(found: CampaignAudit) -> None:
    """Print a row an artifact, and all problems and notes in full below."""
    now = datetime.now(UTC)
    table = Table(box=None)
    for title in ("artifact", "schema", "digest", "chain", "age", "made by", "verdict"):
        table.add_column(title, no_wrap=True)
    for record in found.artifacts:
        table.add_row(*_row(record, found.results, now))
    for item in found.files:
        if item.findings:
            name = item.path.relative_to(found.results).as_posix()
            table.add_row(name, item.kind, "", "", "", "", item.verdict)
    console = Console(highlight=False, markup=False, soft_wrap=True)
    whole = console.measure(table, options=console.options.update(max_width=_WIDEST)).maximum
    console.width = max(console.width, whole)  # digests are to be searched for, so nothing is cut
    console.print(table)
    for finding in found.findings:
        console.print(f"{finding.path}: {finding.problem}")
    for note in found.notes:
        console.print(f"note: {note}")
    console.print(summary(found))


def summary(found: CampaignAudit) -> str:
    """One line."""
    n = len(found.artifacts)
    if not found.sound:
        return f"{len(found.findings)} problems in {n} artifacts; run the campaign again to mend them"
    files = (
        f"{len(found.files)} other files as in the manifest"
        if found.manifest == "present"
        else "other files not checked, for there is no manifest"
    )
    return f"{n} artifacts: complete, unaltered, and made from one another as recorded; {files}"


def _row(record: Record, results: Path, now: datetime) -> tuple[str, ...]:
    name = record.path.relative_to(results).as_posix()
    head = record.header
    if head is None:
        return (name, "", "", "", "", "", record.verdict)
    return (
        name,
        f"{head.schema.removeprefix('warmlens/')} {head.schema_version}",
        head.digest[:12],
        ", ".join(_chain(record.findings)) or "ok",
        age(head.created_utc, now),
        f"{head.package_version} {head.git_commit[:10]}{' dirty' if head.git_dirty else ''}",
        record.verdict,
    )


def _chain(findings: Sequence[Finding]) -> list[str]:
    """What of the chain is broken."""
    return list(dict.fromkeys(finding.kind for finding in findings if finding.kind in _CHAIN))


def age_seconds(created_utc: str, now: datetime) -> float | None:
    """Seconds since a time in UTC, negative if a clock was set back; None if it is no time."""
    try:
        created = datetime.fromisoformat(created_utc)
    except ValueError:
        return None
    return (now - created.replace(tzinfo=created.tzinfo or UTC)).total_seconds()


def age(created_utc: str, now: datetime) -> str:
    """How old something is, in words."""
    seconds = age_seconds(created_utc, now)
    if seconds is None:
        return "unknown"
    if seconds < 0.0:
        return "in the future"
    return f"{seconds / _DAY:.0f} d" if seconds > 2.0 * _DAY else duration(seconds)


def as_json(found: CampaignAudit) -> str:
    """The audit as JSON; docs/audit.md tells the keys."""
    now = datetime.now(UTC)
    content = {
        "format": "warmlens/audit",
        "format_version": 1,
        "results": str(found.results),
        "sound": found.sound,
        "n_problems": len(found.findings),
        "manifest": found.manifest,
        "artifacts": [_artifact(record, found.results, now) for record in found.artifacts],
        "files": [
            {
                "path": item.path.relative_to(found.results).as_posix(),
                "kind": item.kind,
                "verdict": item.verdict,
                "problems": [finding.problem for finding in item.findings],
            }
            for item in found.files
        ],
        "problems": [
            {"path": str(finding.path), "kind": finding.kind, "problem": finding.problem}
            for finding in found.findings
        ],
        "notes": list(found.notes),
    }
    return json.dumps(content, indent=2)


def _artifact(record: Record, results: Path, now: datetime) -> dict[str, Any]:
    head = record.header
    told: dict[str, Any] = dict.fromkeys((*_ATTRIBUTES, "stage_version", "chain", "age_seconds"))
    if head is not None:
        told |= {name: getattr(head, name) for name in _ATTRIBUTES}
        told["stage_version"] = head.settings.get("stage_version")
        told["chain"] = _chain(record.findings)
        told["age_seconds"] = age_seconds(head.created_utc, now)
    return {
        "path": record.path.relative_to(results).as_posix(),
        "stage": record.stage,
        **told,
        "verdict": record.verdict,
        "problems": [finding.problem for finding in record.findings],
    }
