"""What a start finds in a results folder: artifacts that do not fit the configuration, and times out of order.

Snakemake compares times and its own records, which can be lost, copied or emptied. A start compares what the
artifacts state about themselves: digests of their settings and inputs. Those that do not fit are recomputed, also
where Snakemake would keep them; those that fit are kept, also where Snakemake would take them for outdated.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from warmlens.artifacts.atomic import ArtifactError, atomic_path
from warmlens.artifacts.chain import Chain, Finding, Record
from warmlens.artifacts.file import input_digest
from warmlens.artifacts.names import ANSWER_FILES, CONFIG, CRATE, LEDGER, MANIFEST, REPORT, STARTED
from warmlens.campaign.answer import settings_changes
from warmlens.campaign.derived import (
    REPORT_LEDGER,
    derived_files,
    derived_findings,
    drawn_groups,
    figure_files,
    figure_inputs,
    ledgers,
    report_inputs,
)
from warmlens.campaign.files import note_file, stage_file, stage_spans
from warmlens.config.model import Config
from warmlens.sampling import Span
from warmlens.stage_table import STAGES, campaign_stages, stage_digests
from warmlens.text import duration

YES = "WARMLENS_YES"  # environment: "1" discards what does not fit, ASK asks first where there is a terminal
ASK = "ask"
_SHOWN = 3  # reasons and files by name; the others are counted
_SHOWN_STAGES = 6
_WIDEST = 240  # of a reason


@dataclass(frozen=True)
class Present:
    """Artifacts in a results folder that do not fit a configuration.

    Attributes
    ----------
    broken
        Artifacts that are damaged, have other settings, or were made from an input that has changed since.
    stale
        Computing time [s] of each of these and of everything that was made from them; 0 if it cannot be read.
    reasons
        What is wrong, one text for all artifacts with the same problem.
    derived
        What is wrong with other files, such as `abc.json` and figures: they take seconds.
    state
        Digests of all settings and of the files of the observation.
    agreed
        Whether the last start had the same state, or files are damaged or gone but none has changed.
    """

    config: Config
    broken: Mapping[Path, Finding] = field(default_factory=dict)
    stale: Mapping[str, Mapping[Path, float]] = field(default_factory=dict)
    reasons: Sequence[str] = ()
    derived: Sequence[Finding] = ()
    state: Mapping[str, Any] = field(default_factory=dict)
    agreed: bool = False

    @property
    def to_make(self) -> set[Path]:
        """Files that are to be made again even if Snakemake takes them for up to date."""
        return {*self.broken, *(finding.path for finding in self.derived)}

    def describe_derived(self) -> str:
        """Return in one line which files are not what their artifacts give, but for those that are only older."""
        altered = [str(finding.path) for finding in self.derived if finding.kind in ("altered", "damaged")]
        if not altered:
            return ""
        return f"not what the artifacts give, and made from them again: {_listed(altered, _SHOWN, ', ')}"

    def describe(self, planned: Collection[str] | None = None) -> str:
        """Return in one line what does not fit, of `planned` or of all: numbers, time, reasons; "" if nothing.

        The answer does not count: it takes seconds, and every extension changes it.
        """
        counts: dict[str, int] = {}
        seconds = 0.0
        for stage, times in self.stale.items():
            lost = [time for path, time in times.items() if planned is None or str(path) in planned]
            if lost and stage != campaign_stages(self.config)[-1]:
                counts[stage] = len(lost)
                seconds += sum(lost)
        if not counts:
            return ""
        n, verb = sum(counts.values()), "does" if sum(counts.values()) == 1 else "do"
        stages = _listed([f"{number} {stage}" for stage, number in counts.items()], _SHOWN_STAGES, ", ")
        return (
            f"{self.config.results}: {n} finished artifact{'s' * (n > 1)} ({stages}; {duration(seconds)} of "
            f"computing) {verb} not fit the configuration: {_listed(self.reasons, _SHOWN, '; ')}"
        )


def compare_present(config: Config) -> Present:
    """Compare every artifact in the results folder with the configuration and with its inputs, by the headers.

    Raises
    ------
    ArtifactError
        If the system refuses to read one: it may be sound.
    """
    outside = _outside_digests(config)
    digests = stage_digests(config)
    chain, answer = Chain(digests), campaign_stages(config)[-1]
    broken: dict[Path, Finding] = {}
    stale: dict[str, dict[Path, float]] = {stage: {} for stage in campaign_stages(config)}
    reasons: dict[str, list[str]] = {}
    known: dict[Path, str] = {}
    changed = False
    for stage in stale:
        for span in stage_spans(config, stage):
            path = stage_file(config, stage, span)
            if not path.exists():
                continue
            record = chain.compare(path, stage)
            if record.header is not None:
                known[path] = record.header.digest
            finding = _first_finding(record, outside)
            if finding is not None and finding.kind == "unreadable":  # it may be sound
                raise finding.to_error()
            follows = _follows(config, stage, span, stale)
            if finding is not None:
                broken[path] = finding
                if stage != answer and (not follows or finding.kind == "settings"):
                    kind, reason = _reason(record, finding, config)
                    reasons.setdefault(kind, []).append(reason)
                    changed |= finding.kind != "damaged" and finding.absent is None and finding.cause is None
            if finding is not None or follows:
                stale[stage][path] = record.header.wall_seconds if record.header else 0.0
    texts = [texts[0] + (f" and {len(texts) - 1} more" if len({*texts}) > 1 else "") for texts in reasons.values()]
    state = {"settings": digests, "files": outside}
    derived = derived_findings(config, known, broken)
    agreed = not changed or _read_started(config) == state
    return Present(config, broken, stale, texts, derived, state, agreed)


def _outside_digests(config: Config) -> dict[str, str]:
    """Return the digest of every file that the observation is made from, by its name in the artifact."""
    block = config.observation
    if block.kind == "simulated":
        return {}
    from warmlens.products.images import artifact_path, input_files  # astropy takes a second to load

    if block.kind == "artifact":
        return {"artifact": input_digest(artifact_path(block))}
    assert block.fits is not None  # config: kind fits comes with its block
    files = {f"{band}/{key}": path for band in block.bands for key, path in input_files(block.fits[band]).items()}
    return {name: input_digest(path) for name, path in files.items() if path.is_file()}


def _first_finding(record: Record, outside: Mapping[str, str]) -> Finding | None:
    """Return the first problem of an artifact; of files of the user only the digest counts, not where they are."""
    if record.stage != "observation":
        return next(iter(record.findings), None)
    for finding in record.findings:
        if finding.kind != "inputs":
            return finding
    recorded = {} if record.header is None else record.header.inputs
    changed = [name for name, digest in outside.items() if recorded.get(name, {}).get("digest") != digest]
    return Finding(record.path, f"made from another {', '.join(changed)}", "inputs") if changed else None


def _follows(config: Config, stage: str, span: Span | None, stale: Mapping[str, Mapping[Path, float]]) -> bool:
    """Return whether an artifact was made from one that is stale."""
    return any(
        bool(stale[source])
        if STAGES[stage].reads_all_of(source)
        else stage_file(config, source, span) in stale[source]
        for source in STAGES[stage].inputs.values()
    )


def _reason(record: Record, finding: Finding, config: Config) -> tuple[str, str]:
    """Return what is wrong with an artifact: a key that those with the same problem share, and a text."""
    if finding.kind == "settings" and record.header is not None:
        text = settings_changes(config, record.header)
        return text, text if len(text) <= _WIDEST else f"{text[:_WIDEST]}..."
    name = record.path.relative_to(config.results)
    problem = "damaged" if finding.kind == "damaged" else finding.problem
    return f"{record.stage} {finding.kind}", f"{name}: {problem}"


def _listed(texts: Sequence[str], shown: int, separator: str) -> str:
    more = f" and {len(texts) - shown} more" if len(texts) > shown else ""
    return separator.join(texts[:shown]) + more


def order_times(present: Present) -> int:
    """Give artifacts that fit but are older than an input, as after `cp -r`, its time; return how many.

    Snakemake would take them for outdated.
    """
    config, n_changed = present.config, 0
    newest: dict[str, int] = {}  # time of the last artifact of a stage [ns]
    for stage in campaign_stages(config):
        for span in stage_spans(config, stage):
            path = stage_file(config, stage, span)
            if path.exists() and path not in present.stale[stage]:
                earliest = _newest_input(config, stage, span, newest)
                _not_before(note_file(config, stage, "benchmarks", span), earliest)  # Snakemake looks at it, too
                beside = [path.with_name(name) for name in ANSWER_FILES.get(stage, ())]
                n_changed += sum(_not_before(each, earliest) for each in (path, *beside))
            newest[stage] = max(newest.get(stage, 0), _time_ns(path))
    return n_changed + _order_derived(present)


def _order_derived(present: Present) -> int:
    """Do the same for figures, the report and the manifest that are what their artifacts give."""
    config, root = present.config, Path(present.config.results)
    wrong, records, notes, n_changed = present.to_make, {*ledgers(config)}, root / "benchmarks", 0
    steps: list[tuple[list[Path], list[Path]]] = []
    for group, names in drawn_groups(config).items():
        inputs = [path for name in names for path in figure_inputs(config, name).values()]
        outputs = [path for name in names for path in figure_files(config, name)]
        outputs += [root / LEDGER.format(name=name) for name in names]
        steps.append(([*outputs, notes / f"figures/{group}.tsv"], inputs))
    answer = [root / name for name in ANSWER_FILES[campaign_stages(config)[-1]]]
    steps.append(([root / REPORT, root / REPORT_LEDGER, notes / "report.tsv"], [*report_inputs(config), *answer]))
    steps.append(
        ([root / MANIFEST, root / CRATE, notes / "manifest.tsv"], [*report_inputs(config), *derived_files(config)])
    )
    for outputs, inputs in steps:
        if wrong.isdisjoint(outputs) and all(path.exists() for path in {*outputs} & records):
            earliest = max(_time_ns(path) for path in inputs if path.name != CONFIG)  # written at every start
            n_changed += sum(_not_before(path, earliest) for path in outputs)
    return n_changed


def _newest_input(config: Config, stage: str, span: Span | None, newest: Mapping[str, int]) -> int:
    sources = [source for source in STAGES[stage].inputs.values() if source in newest]
    times = [
        newest[source] if STAGES[stage].reads_all_of(source) else _time_ns(stage_file(config, source, span))
        for source in sources
    ]
    return max(times, default=0)


def _time_ns(path: Path) -> int:
    return path.stat().st_mtime_ns if path.exists() else 0


def _not_before(path: Path, earliest: int) -> bool:
    """Give a file that is older than `earliest` [ns] this time; return whether it was."""
    if not path.exists() or path.stat().st_mtime_ns >= earliest:
        return False
    os.utime(path, ns=(earliest, earliest))
    return True


def check_consent(present: Present, planned: Collection[str]) -> None:
    """Return if nothing finished is to be discarded for a change of settings or images, or if that is wanted.

    Parameters
    ----------
    planned
        Files that the start would make, whether they exist or not.

    Raises
    ------
    ArtifactError
        Otherwise: naming what would be lost, and what to do.
    """
    lost = present.describe(planned)
    answer = os.environ.get(YES, "")
    if not lost or present.agreed or answer == "1":
        return
    if answer == ASK and sys.stdin.isatty():
        if input(f"{lost}. Discard and recompute them? [y/N] ").strip().lower() in ("y", "yes"):
            return
        raise ArtifactError("nothing was changed; other `results`, or `warmlens branch`, keep what is finished")
    raise ArtifactError(
        f"{lost}; nothing was changed: --yes discards and recomputes them (snakemake itself: {YES}=1); other "
        "`results`, or `warmlens branch`, keep them"
    )


def write_started(present: Present) -> None:
    """Record the settings and images that a campaign is started with: their change has been agreed to."""
    with atomic_path(Path(present.config.results) / STARTED) as temporary:
        temporary.write_text(json.dumps(present.state, indent=2) + "\n", encoding="utf-8")


def _read_started(config: Config) -> Any:
    """Return the state that the last start has recorded; None if there was none, or it is not readable."""
    try:
        return json.loads((Path(config.results) / STARTED).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
