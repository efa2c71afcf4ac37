"""What is printed, combined or drawn: artifacts whose chain has been followed back to the observation."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.chain import Chain, Finding, Record, walk
from warmlens.artifacts.file import Artifact, Header, open_artifact, read_header
from warmlens.artifacts.names import CONFIG, SINGLE
from warmlens.campaign.derived import derived_findings
from warmlens.campaign.files import stage_files
from warmlens.campaign.status import read_campaign
from warmlens.config.digest import settings_digest
from warmlens.config.model import Config
from warmlens.stage_table import campaign_stages, stage_digests, stage_settings

_NONE = "none"
_SHOWN = 3  # settings that differ, by name; the others are counted

_NAMES = {  # of what is not called as in the configuration
    "stage_version": "version of the stage's code",
    "seed": "campaign.seed",
    "n_samples": "campaign.n_samples",
}

log = logging.getLogger(__name__)


@contextlib.contextmanager
def open_answer(results: Path, stage: str = "abc") -> Iterator[Artifact]:
    """Open an answer of the campaign in a results folder, after following its chain; see `check_chain`."""
    path = results / SINGLE[stage]
    check_chain(read_campaign(results), [path])
    with open_artifact(path, stage) as artifact:
        yield artifact


def check_chain(config: Config, paths: Iterable[Path]) -> None:
    """Check that artifacts, and all that they were made from, are unaltered and belong to a configuration.

    The content of the artifacts themselves is hashed; for those that they were made from, `audit` does that. What
    they were made from may be gone, as images are on another machine: the log then says what was not compared.

    Raises
    ------
    ArtifactError
        Naming the first artifact that does not fit, why, and what to do.
    """
    # inputs lie beside the artifact itself, not beside a link to it
    files = {path.resolve() if path.is_symlink() else path: "" for path in paths}
    absent: list[Path] = []
    for record in walk(files, stage_digests(config), hashed=files):
        for finding in record.findings:
            if finding.absent is None:
                raise _to_error(config, record, finding)
            absent.append(finding.absent)
    if absent:
        log.warning(
            "%s: %d files that it was made from are not there and were not compared, such as %s",
            *(", ".join(map(str, files)), len({*absent}), absent[0]),
        )


def answer_problems(config: Config) -> list[str]:
    """Say in a line each whether the answer, and what derives from it, belong to other settings or artifacts.

    Only headers and the derived files are read. A manifest that is not up to date is left out: it comes last.
    """
    path = Path(config.results) / SINGLE[campaign_stages(config)[-1]]
    lines = []
    if path.exists():
        record = Chain(stage_digests(config)).compare(path)
        wrong = [finding for finding in record.findings if finding.absent is None]
        lines = [f"{_to_error(config, record, finding)}" for finding in wrong[:1]]
    names = [finding.path.name for finding in derived_findings(config) if finding.kind != "manifest"]
    if names:
        more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        lines.append(
            f"not what they derive from: {', '.join(names[:_SHOWN])}{more}; "
            f"`warmlens audit {config.results}` says how to mend it"
        )
    return lines


def _to_error(config: Config, record: Record, finding: Finding) -> ArtifactError:
    if finding.kind == "settings" and record.header is not None:
        return other_settings(config, record.header)
    if finding.kind == "inputs":
        return ArtifactError(f"{finding.path}: {finding.problem}; {_remedy(config)}")
    return finding.to_error()


def other_settings(config: Config, header: Header) -> ArtifactError:
    """Return the error for an artifact with other settings than its campaign."""
    changes = settings_changes(config, header)
    return ArtifactError(f"{header.path}: belongs to other settings than {CONFIG} ({changes}); {_remedy(config)}")


def _remedy(config: Config) -> str:
    return f"`warmlens resume {config.results}` makes it again, `warmlens audit {config.results}` shows everything"


def settings_changes(config: Config, header: Header) -> str:
    """Return in words what differs between the settings of an artifact and those of its stage in a campaign.

    An answer has the digests of the settings of all stages before it. The first that has changed is named by its
    keys, as its own artifact has them, if that is still there.
    """
    current = stage_settings(config, header.stage).as_dict()
    before, now = header.settings.get("upstream"), current.get("upstream")
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for stage in (name for name in now if before.get(name) not in (None, now[name])):
            with contextlib.suppress(ArtifactError, IndexError):
                recorded = read_header(stage_files(config, stage)[0]).settings
                if settings_digest(recorded) == before[stage]:
                    return differences(recorded, stage_settings(config, stage).as_dict())
    return differences(header.settings, current)


def differences(recorded: Mapping[str, Any], current: Mapping[str, Any]) -> str:
    """Return in words which settings differ: the version of the stage's code first, then keys with both values."""
    before, now = dict(_leaves(recorded)), dict(_leaves(current))
    keys = [key for key in {**before, **now} if before.get(key, _NONE) != now.get(key, _NONE)]
    keys.sort(key=lambda key: key != "stage_version")
    parts = [_difference(key, before.get(key, _NONE), now.get(key, _NONE)) for key in keys[:_SHOWN]]
    return ", ".join(parts) + (f" and {len(keys) - _SHOWN} more" if len(keys) > _SHOWN else "")


def _difference(key: str, before: Any, now: Any) -> str:
    if key.startswith("upstream."):
        return f"the settings of {key.removeprefix('upstream.')} have changed"
    return f"{_NAMES.get(key, key)} was {before}, is now {now}"


def _leaves(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
