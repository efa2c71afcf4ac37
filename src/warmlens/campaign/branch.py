"""Start a campaign from another one: artifacts that the change does not affect are hard-linked."""

from __future__ import annotations

import errno
import json
import logging
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from warmlens.artifacts.atomic import ArtifactError, atomic_path
from warmlens.artifacts.chain import Chain
from warmlens.artifacts.file import input_digest
from warmlens.artifacts.names import CONFIG, SINGLE
from warmlens.campaign.files import artifact_files, stage_files
from warmlens.campaign.start import check_consent, compare_present
from warmlens.config.model import Config
from warmlens.stage_table import campaign_stages, stage_digests, stage_settings

log = logging.getLogger(__name__)

MARK = "branch.json"
_NO_LINK = (errno.EXDEV, errno.EPERM, errno.EMLINK, errno.EOPNOTSUPP)


@dataclass(frozen=True)
class StageBranch:
    """Number of artifacts of one stage in a branch, before it is run.

    Linked are those just taken from the base, there those found in place, removed those of other settings.
    """

    stage: str
    n_files: int
    n_linked: int
    n_there: int
    n_removed: int

    @property
    def complete(self) -> bool:
        """Whether nothing of the stage is left to be computed."""
        return self.n_linked + self.n_there == self.n_files


def branch(base: Path, config: Config, yes: bool = False) -> list[StageBranch]:
    """Hard-link all artifacts of the results folder `base` that are right for `config` into `config.results`.

    An artifact is right if it is complete, was made with exactly the settings that its stage has under `config`,
    and all its inputs in the new folder have the content that it was made from. Across file systems it is
    copied. Times are kept, so that Snakemake finds it up to date. The last stage is always left to the workflow.
    The new folder may hold an earlier, also an interrupted, branch; with `yes`, what it has computed with other
    settings is removed without asking.

    Raises
    ------
    ArtifactError
        If the base is no campaign, or the new folder holds a campaign that is no branch, or artifacts of its own
        that would be removed.
    """
    target = Path(config.results)
    _check_folders(base, target, config)
    if not yes and (target / MARK).is_file():
        check_consent(compare_present(config), _computed_in(target, base, config))
    with atomic_path(target / MARK) as temporary:
        temporary.write_text(json.dumps({"base": os.path.relpath(base, target)}) + "\n", encoding="utf-8")
    digests = stage_digests(config)
    branches = []
    for stage in campaign_stages(config)[:-1]:
        linked, there, removed = 0, 0, 0
        files = stage_files(config, stage)
        chain = Chain(digests)  # a new one per stage, for the files of the last one have changed
        for place in files:
            source = base / place.relative_to(target)
            if _fits(chain, place, place, stage):
                there += 1
            elif _fits(chain, source, place, stage):
                _link(source, place)
                linked += 1
            elif place.exists():
                place.unlink()  # Snakemake keeps no record of a link, and would take it as it is
                removed += 1
        if stage == "observation":
            there += _observe(config, base) if not linked + there else 0
            _date_like(base / SINGLE[stage], target / SINGLE[stage])
        branches.append(StageBranch(stage, len(files), linked, there, removed))
    return branches


def _computed_in(target: Path, base: Path, config: Config) -> set[str]:
    """Return the artifacts of an earlier branch that are no links to those of the base."""
    paths = [path for path in artifact_files(config) if path.exists()]
    originals = {path: base / path.relative_to(target) for path in paths}
    return {
        str(path) for path, original in originals.items() if not (original.exists() and path.samefile(original))
    }


def _check_folders(base: Path, target: Path, config: Config) -> None:
    if not (base / CONFIG).is_file():
        raise ArtifactError(
            f"{base / CONFIG}: no such file; is {base} the results folder of a campaign that was run?"
        )
    if target.resolve() == base.resolve():
        raise ArtifactError(f"{target}: a branch needs a folder of its own; give another `results` in the overlay")
    if (target / MARK).is_file():
        return
    if any(path.exists() for path in artifact_files(config)):
        raise ArtifactError(
            f"{target}: holds a campaign that is no branch of another one; give another `results` in the overlay"
        )


def _fits(chain: Chain, path: Path, place: Path, stage: str) -> bool:
    """Return whether the artifact `path` is what the campaign needs at `place`."""
    if not path.exists():
        return False
    findings = chain.compare(path, stage, place=place).findings
    for finding in findings:
        if finding.kind == "unreadable":  # it may be sound, and what does not fit is removed
            raise finding.to_error()
        if finding.cause:
            log.warning("not used, and recomputed: %s", finding.cause)
    return not findings


def _link(source: Path, place: Path) -> None:
    with atomic_path(place) as temporary:
        try:
            os.link(source, temporary)
        except OSError as error:
            if error.errno not in _NO_LINK:
                raise
            shutil.copy2(source, temporary)


def _observe(config: Config, base: Path) -> int:
    """Read an image of the user or of another campaign, so that artifacts made from it can be linked; 1 if so.

    The artifact records the path of its file relative to itself, so it cannot be linked.
    """
    from warmlens.stages.job import make_job, run_job  # what reads images takes a second to load

    if config.observation.kind == "simulated" or not (base / SINGLE["observation"]).is_file():
        return 0
    output = Path(config.results) / SINGLE["observation"]
    run_job(make_job("observation", stage_settings(config, "observation"), output))
    return 1


def _date_like(original: Path, path: Path) -> None:
    """Give `path` the time of `original` if both hold the same: what was made from either is then up to date."""
    if not (original.exists() and path.exists()) or path.samefile(original):
        return
    try:
        same = input_digest(original) == input_digest(path)
    except ArtifactError as error:
        log.warning("%s", error)
        return
    if same:
        stat = original.stat()
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
