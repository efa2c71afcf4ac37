"""An audit as a table for people, and as JSON for scripts."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.table import Table

from warmlens.artifacts.chain import Record
from warmlens.audit.campaign import CampaignAudit
from warmlens.audit.mending import Mending
from warmlens.text import Terminal, duration

_DAY = 86400.0
_WIDEST = 400
_CHAIN = ("settings", "inputs")
_ATTRIBUTES = (
    *("schema", "schema_version", "digest", "settings_sha256", "created_utc", "wall_seconds"),
    *("package_version", "git_commit", "git_dirty", "machine"),
)


def print_audit(audit: CampaignAudit, mend: Mending) -> None:
    """Print one row per artifact and per file with a problem; below all problems, notes, and how to mend it."""
    now = datetime.now(UTC)
    table = Table(box=None)
    for title in ("artifact", "schema", "digest", "chain", "age", "made by", "verdict"):
        table.add_column(title, no_wrap=True)
    for record in audit.artifacts:
        table.add_row(*_row(record, audit.results, now))
    for record in audit.files:
        if record.findings:
            table.add_row(_name(record, audit.results), record.stage, "", "", "", "", record.verdict)
    console = Terminal(markup=False)
    whole = console.measure(table, options=console.options.update(max_width=_WIDEST)).maximum
    console.width = max(console.width, whole)  # digests are searched for, so nothing is cut
    console.print(table)
    for finding in audit.findings:
        console.print(f"{finding.path}: {finding.problem}")
    for note in audit.notes:
        console.print(f"note: {note}")
    console.print(_summary(audit))
    for text in mend.advice:
        console.print(text)
    if mend.commands:
        console.print("these commands mend it:")
        for command in mend.commands:
            console.print(f"  {command}")


def _summary(audit: CampaignAudit) -> str:
    n = len(audit.artifacts)
    if not audit.sound:
        return f"{len(audit.findings)} problems in {n} artifacts and {len(audit.files)} other files"
    unchecked = (
        f", {len(audit.unchecked)} of them not checked, for there is no manifest" if audit.unchecked else ""
    )
    manifest = " and as in the manifest" if audit.manifest == "present" else ""
    files = f"{len(audit.files)} other files as they were made{manifest}{unchecked}"
    return f"{n} artifacts: complete, unaltered, and made from one another as recorded; {files}"


def _name(record: Record, results: Path) -> str:
    return record.path.relative_to(results).as_posix()


def _row(record: Record, results: Path, now: datetime) -> tuple[str, ...]:
    header = record.header
    if header is None:
        return (_name(record, results), "", "", "", "", "", record.verdict)
    return (
        _name(record, results),
        f"{header.schema.removeprefix('warmlens/')} {header.schema_version}",
        header.digest[:12],
        ", ".join(_broken_links(record)) or "ok",
        age(header.created_utc, now),
        f"{header.package_version} {header.git_commit[:10]}{' dirty' if header.git_dirty else ''}",
        record.verdict,
    )


def _broken_links(record: Record) -> list[str]:
    return list(dict.fromkeys(finding.kind for finding in record.findings if finding.kind in _CHAIN))


def age_seconds(created_utc: str, now: datetime) -> float | None:
    """Return the seconds since a time in UTC, negative if a clock was set back; None if the text is no time."""
    try:
        created = datetime.fromisoformat(created_utc)
    except ValueError:
        return None
    return (now - created.replace(tzinfo=created.tzinfo or UTC)).total_seconds()


def age(created_utc: str, now: datetime) -> str:
    """Return the time since a time in UTC, in words."""
    seconds = age_seconds(created_utc, now)
    if seconds is None:
        return "unknown"
    if seconds < 0.0:
        return "in the future"
    return f"{seconds / _DAY:.0f} d" if seconds > 2.0 * _DAY else duration(seconds)


def as_json(audit: CampaignAudit, mend: Mending) -> str:
    """Return the audit and how to mend it as JSON, with the keys of docs/audit.md."""
    now = datetime.now(UTC)
    content = {
        "format": "warmlens/audit",
        "format_version": 1,
        "results": str(audit.results),
        "sound": audit.sound,
        "n_problems": len(audit.findings),
        "manifest": audit.manifest,
        "artifacts": [_artifact(record, audit.results, now) for record in audit.artifacts],
        "files": [
            {
                "path": _name(record, audit.results),
                "kind": record.stage,
                "verdict": "unchecked" if record.path in audit.unchecked else record.verdict,
                "problems": [finding.problem for finding in record.findings],
            }
            for record in audit.files
        ],
        "problems": [
            {"path": str(finding.path), "kind": finding.kind, "problem": finding.problem}
            for finding in audit.findings
        ],
        "notes": list(audit.notes),
        "advice": list(mend.advice),
        "commands": list(mend.commands),
    }
    return json.dumps(content, indent=2)


def _artifact(record: Record, results: Path, now: datetime) -> dict[str, Any]:
    header = record.header
    stated: dict[str, Any] = dict.fromkeys((*_ATTRIBUTES, "stage_version", "chain", "age_seconds"))
    if header is not None:
        stated |= {name: getattr(header, name) for name in _ATTRIBUTES}
        stated["stage_version"] = header.settings.get("stage_version")
        stated["chain"] = _broken_links(record)
        stated["age_seconds"] = age_seconds(header.created_utc, now)
    return {
        "path": _name(record, results),
        "stage": record.stage,
        **stated,
        "verdict": record.verdict,
        "problems": [finding.problem for finding in record.findings],
    }
