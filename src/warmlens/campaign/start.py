"""What a start finds in a results folder: artifacts that do not fit the configuration, and times out of order.

Snakemake compares times and its own records, which can be lost, copied or emptied. A start compares what the
artifacts state about themselves: digests of their settings and inputs. Those that do not fit are recomputed, also
where Snakemake would keep them; those that fit are kept, also where Snakemake would take them for outdated.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from warmlens.artifacts.chain import Chain, Finding, Record
from warmlens.artifacts.file import ArtifactError, atomic_path, input_digest
from warmlens.artifacts.names import ANSWER_FILES, STARTED
from warmlens.campaign.files import note_file, stage_file, stage_spans
from warmlens.config.model import Config
from warmlens.sampling import Span
from warmlens.stage_table import STAGES, campaign_stages, stage_digests, stage_settings
from warmlens.text import duration

YES = "WARMLENS_YES"  # environment: "1" discards what does not fit, ASK asks first where there is a terminal
ASK = "ask"
_NONE = "none"
_SHOWN = 3  # settings that differ, and reasons, by name; the others are counted
_SHOWN_STAGES = 6
_WIDEST = 80  # of a value in a message


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
    state
        Digests of all settings and of the files of the observation.
    agreed
        Whether the last start of the campaign had the same state.
    """

    config: Config
    broken: Mapping[Path, Finding] = field(default_factory=dict)
    stale: Mapping[str, Mapping[Path, float]] = field(default_factory=dict)
    reasons: Sequence[str] = ()
    state: Mapping[str, Any] = field(default_factory=dict)
    agreed: bool = False

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
    """Compare every artifact in the results folder with the configuration and with its inputs, by the headers."""
    outside = _outside_digests(config)
    digests = stage_digests(config)
    chain, answer = Chain(digests), campaign_stages(config)[-1]
    broken: dict[Path, Finding] = {}
    stale: dict[str, dict[Path, float]] = {stage: {} for stage in campaign_stages(config)}
    reasons: dict[str, list[str]] = {}
    for stage in stale:
        for span in stage_spans(config, stage):
            path = stage_file(config, stage, span)
            if not path.exists():
                continue
            record = chain.compare(path, stage)
            finding = _first_finding(record, outside)
            follows = _follows(config, stage, span, stale)
            if finding is not None:
                broken[path] = finding
                if stage != answer and (not follows or finding.kind == "settings"):
                    kind, reason = _reason(record, finding, config)
                    reasons.setdefault(kind, []).append(reason)
            if finding is not None or follows:
                stale[stage][path] = record.header.wall_seconds if record.header else 0.0
    texts = [texts[0] + (f" and {len(texts) - 1} more" if len({*texts}) > 1 else "") for texts in reasons.values()]
    state = {"settings": digests, "files": outside}
    return Present(config, broken, stale, texts, state, _read_started(config) == state)


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
        text = differences(record.header.settings, stage_settings(config, record.stage).as_dict())
        return text, text
    name = record.path.relative_to(config.results)
    problem = "damaged" if finding.kind == "damaged" else finding.problem
    return f"{record.stage} {finding.kind}", f"{name}: {problem}"


def differences(recorded: Mapping[str, Any], current: Mapping[str, Any]) -> str:
    """Return in words which settings differ: the version of the stage's code first, then keys with both values."""
    before, now = dict(_leaves(recorded)), dict(_leaves(current))
    keys = [key for key in {**before, **now} if before.get(key, _NONE) != now.get(key, _NONE)]
    keys.sort(key=lambda key: key != "stage_version")
    return _listed([_difference(key, before.get(key, _NONE), now.get(key, _NONE)) for key in keys], _SHOWN, ", ")


def _difference(key: str, before: Any, now: Any) -> str:
    if key.startswith("upstream."):
        return f"the settings of {key.removeprefix('upstream.')} have changed"
    name = "version of the stage's code" if key == "stage_version" else key
    return f"{name} was {_shortened(before)}, is now {_shortened(now)}"


def _shortened(value: Any) -> str:
    text = str(value)
    return text if len(text) <= _WIDEST else f"{text[: _WIDEST - 3]}..."


def _leaves(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


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
        f"{lost}; nothing was changed: give --yes to discard and recompute them (or {YES}=1 where snakemake itself "
        "is called); other `results`, or `warmlens branch`, keep them"
    )


def write_started(present: Present) -> None:
    """Record the settings and images that a campaign is started with: their change has been agreed to."""
    with atomic_path(Path(present.config.results) / STARTED) as temporary:
        temporary.write_text(json.dumps(present.state, indent=2) + "\n")


def _read_started(config: Config) -> Any:
    """Return the state that the last start has recorded; None if there was none, or it is not readable."""
    try:
        return json.loads((Path(config.results) / STARTED).read_text())
    except (OSError, ValueError, RecursionError):
        return None
