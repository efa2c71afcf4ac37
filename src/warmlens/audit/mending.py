"""How to mend what an audit has found: files to remove, and the commands that make them again."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from warmlens.artifacts.chain import Record
from warmlens.audit.campaign import CampaignAudit
from warmlens.campaign.snakemake import recorded_results
from warmlens.text import duration

_MAX_TYPED = 6  # files in a command; more are left to `warmlens audit --remove`


@dataclass(frozen=True)
class Mending:
    """What to do about an audit.

    Attributes
    ----------
    advice
        Sentences: what no command mends, and what the commands discard.
    remove
        Files that are wrong, all of which the workflow can make again.
    commands
        Command lines to be given one after the other; none if nothing is wrong, or nothing that a command mends.
    """

    advice: tuple[str, ...]
    remove: tuple[Path, ...]
    commands: tuple[str, ...]


def mending(audit: CampaignAudit, overlays: Sequence[Path] = ()) -> Mending:
    """Return how to mend what an audit of a campaign has found, with `overlays` if it was compared with these."""
    records = (*audit.artifacts, *audit.files)
    of_manifest = [finding.path for finding in audit.manifest_findings]
    exchanged = _exchanged(audit.artifacts)
    wrong = [record.path for record in records if _is_wrong(record) or record.path in exchanged]
    missing = any(record.verdict == "missing" or _lacks_artifact(record) for record in records)
    advice = _outside_advice(audit) + _discard_advice(audit)
    if not wrong and not missing:
        return Mending(advice, (), _manifest_commands(audit) if of_manifest else ())
    folder, results, moved = _working_folder(audit.results)
    remove = [path for path in (*wrong, *of_manifest) if path.exists()]
    commands = [f"cd {shlex.quote(str(folder))}"] if folder else []
    if len(remove) > _MAX_TYPED:
        words = [word for path in overlays for word in ("--configfile", str(path))]
        commands.append(shlex.join(["warmlens", "audit", str(results), *words, "--remove"]))
    elif remove:
        words = ["rm", "-r"] if any(path.is_dir() for path in remove) else ["rm"]
        commands.append(shlex.join([*words, *(str(results / path.relative_to(audit.results)) for path in remove)]))
    commands.append(_start_command(results, overlays))
    return Mending((*advice, *moved), tuple(remove), tuple(commands))


def _start_command(results: Path, overlays: Sequence[Path]) -> str:
    words = [word for path in overlays for word in ("--configfile", str(path))]
    return shlex.join(["warmlens", *(["run", *words] if overlays else ["resume", str(results)]), "--yes"])


def _manifest_commands(audit: CampaignAudit) -> tuple[str, ...]:
    return (shlex.join(["warmlens", "manifest", str(audit.results)]),)


def _is_wrong(record: Record) -> bool:
    """Return whether a file is to be removed; not if it may be sound, nor for its input, which comes first."""
    return any(
        finding.kind not in ("missing", "unreadable")
        and finding.absent is None
        and not (finding.kind == "inputs" and finding.cause)
        for finding in record.findings
    )


def _exchanged(artifacts: Sequence[Record]) -> set[Path]:
    """Return the sound artifacts whose content is not what another was made from, though of the same settings.

    The answer records the settings of every stage before it. An artifact with these has the same content whenever
    it is made, so that one that has not was exchanged; one of new settings has just been made, and stays.
    """
    answers = [record.header.settings for record in artifacts if record.header]
    upstream: dict[str, str] = next((settings["upstream"] for settings in answers if "upstream" in settings), {})
    by_place = {record.path.resolve(): record for record in artifacts}
    exchanged = set()
    for user in artifacts:
        for name, source in user.sources.items() if user.header else ():
            record = by_place.get(source.resolve())
            if record is None or record.header is None or record.findings:
                continue
            same_settings = upstream.get(record.stage) == record.header.settings_sha256
            if same_settings and user.header and user.header.inputs[name]["digest"] != record.header.digest:
                exchanged.add(record.path)
    return exchanged


def _lacks_artifact(record: Record) -> bool:
    return record.stage != "observation" and any(finding.absent for finding in record.findings)


def _outside_advice(audit: CampaignAudit) -> tuple[str, ...]:
    """Say what to do about what no command mends: files that cannot be read now, and images."""
    texts = [
        f"make {finding.path} readable: it may be sound"
        for finding in audit.findings
        if finding.kind == "unreadable"
    ]
    for record in audit.artifacts:
        for finding in record.findings if record.stage == "observation" else ():
            if finding.absent:
                texts.append(f"put {finding.absent} back: the campaign cannot make it")
            elif finding.kind == "inputs" and finding.cause:
                texts.append(f"{finding.path}: {finding.problem}; make it readable: the campaign cannot make it")
            elif finding.kind == "inputs":
                texts.append(
                    f"{finding.path}: {finding.problem}; put the old file back if the change was not meant, or "
                    "everything is made from the new one"
                )
    return tuple(texts)


def _discard_advice(audit: CampaignAudit) -> tuple[str, ...]:
    """Say what is lost with artifacts of other settings."""
    others = [record for record in audit.artifacts if any(each.kind == "settings" for each in record.findings)]
    if not others:
        return ()
    seconds = sum(record.header.wall_seconds for record in others if record.header)
    return (
        f"{len(others)} artifacts ({duration(seconds)} of computing) belong to other settings; the commands "
        "discard them and what was made from them. To keep them, set back what was changed",
    )


def _working_folder(results: Path) -> tuple[Path | None, Path, tuple[str, ...]]:
    """Return the folder to go to, None if this is it; the results as seen from there; and what hinders a start."""
    recorded = recorded_results(results)
    place = results.resolve()
    if recorded.resolve() == place and Path("Snakefile").is_file():
        return None, results, ()
    n = len(recorded.parts)
    if not recorded.is_absolute() and place.parts[-n:] == recorded.parts:
        folder = place.parents[n - 1]
        if (folder / "Snakefile").is_file():
            return folder, recorded, ()
    problem = (
        f"the campaign was started as {recorded} in the folder of warmlens, which has the Snakefile; the commands "
        "work there, with the results at that place"
    )
    return None, recorded, (problem,)


def remove_files(paths: Sequence[Path]) -> None:
    """Delete files, and folders in the place of files."""
    for path in paths:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
