"""Where every artifact of a campaign comes from, what it cost, and whether the chain is whole."""

from __future__ import annotations

import csv
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from warmlens.artifacts.chain import check_chain
from warmlens.artifacts.file import ArtifactError, open_artifact
from warmlens.artifacts.names import SINGLE
from warmlens.campaign.files import stage_files
from warmlens.config.model import Config
from warmlens.stage_table import campaign_stages, stage_digests


@dataclass(frozen=True)
class ArtifactRow:
    """One artifact of the campaign.

    Attributes
    ----------
    stage, name
        Its stage, and its path under the results folder.
    digest, settings_digest
        SHA-256 of its content and of the settings that made it.
    commit, dirty, package_version
        The code that made it; whether that had changes that were not committed.
    created
        When it was written, UTC.
    seconds
        Wall time of making it.
    """

    stage: str
    name: str
    digest: str
    settings_digest: str
    commit: str
    dirty: bool
    package_version: str
    created: str
    seconds: float


@dataclass(frozen=True)
class StageCost:
    """What a stage cost: number of artifacts, their wall times together and in the median [s], peak memory [MiB].

    The memory is None where Snakemake did not record it.
    """

    stage: str
    n_artifacts: int
    total_seconds: float
    median_seconds: float
    peak_mib: float | None


@dataclass(frozen=True)
class Provenance:
    """All artifacts of a campaign.

    Attributes
    ----------
    artifacts
        Those that are there, by stage.
    missing
        Paths under the results folder of those that are not.
    chain_problem
        The first artifact that does not fit the one it was made from, or the configuration; "" if all do.
    costs
        One entry a stage that has artifacts.
    """

    artifacts: tuple[ArtifactRow, ...]
    missing: tuple[str, ...]
    chain_problem: str
    costs: tuple[StageCost, ...]

    @property
    def commits(self) -> tuple[str, ...]:
        """Commits of the code that made the artifacts."""
        return tuple(sorted({row.commit for row in self.artifacts}))

    @property
    def dirty(self) -> tuple[str, ...]:
        """Stages with artifacts of code that had changes that were not committed."""
        return tuple(dict.fromkeys(row.stage for row in self.artifacts if row.dirty))

    @property
    def seconds(self) -> float:
        """Wall time of all artifacts together [s]."""
        return sum(cost.total_seconds for cost in self.costs)


def read_provenance(results: Path, config: Config) -> Provenance:
    """Read the attributes of every artifact of a campaign and follow the chain from the posterior.

    Parameters
    ----------
    results
        Results folder.
    config
        Configuration of the last run into it.
    """
    rows: list[ArtifactRow] = []
    missing: list[str] = []
    for stage in campaign_stages(config):
        for path in stage_files(config, stage):
            name = path.relative_to(results).as_posix()
            if path.exists():
                rows.append(_read_row(path, stage, name))
            else:
                missing.append(name)
    try:
        check_chain(results / SINGLE["abc"], stage_digests(config))
        problem = ""
    except ArtifactError as error:
        problem = str(error).replace(f"{results.resolve()}/", "")
    return Provenance(tuple(rows), tuple(missing), problem, _costs(rows, results))


def _read_row(path: Path, stage: str, name: str) -> ArtifactRow:
    with open_artifact(path, stage) as artifact:
        return ArtifactRow(
            stage,
            name,
            artifact.digest,
            artifact.text("settings_sha256"),
            artifact.text("git_commit"),
            artifact.git_dirty,
            artifact.text("package_version"),
            artifact.text("created_utc"),
            artifact.wall_seconds,
        )


def _costs(rows: Sequence[ArtifactRow], results: Path) -> tuple[StageCost, ...]:
    seconds: dict[str, list[float]] = {}
    for row in rows:
        seconds.setdefault(row.stage, []).append(row.seconds)
    return tuple(
        StageCost(stage, len(each), sum(each), statistics.median(each), peak_memory(results / "benchmarks", stage))
        for stage, each in seconds.items()
    )


def peak_memory(benchmarks: Path, stage: str) -> float | None:
    """Largest resident memory [MiB] in Snakemake's benchmark files of a stage; None if there is none."""
    peaks = []
    single = [benchmarks / Path(SINGLE[stage]).with_suffix(".tsv")] if stage in SINGLE else []
    for path in (benchmarks / f"{stage}.tsv", *single, *sorted((benchmarks / stage).glob("*.tsv"))):
        if path.is_file():
            with path.open(newline="") as handle:
                for line in csv.DictReader(handle, delimiter="\t"):
                    text = line.get("max_rss") or ""
                    if text.replace(".", "", 1).isdigit():  # "NA" or "-" where it was not measured
                        peaks.append(float(text))
    return max(peaks, default=None)
