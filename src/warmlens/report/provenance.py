"""Where every artifact of a campaign comes from, what it cost, and whether the chain is whole."""

from __future__ import annotations

import csv
import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warmlens.artifacts.chain import walk
from warmlens.artifacts.file import Header, read_header
from warmlens.artifacts.names import SINGLE
from warmlens.campaign.files import artifact_files
from warmlens.config.model import Config
from warmlens.stage_table import stage_digests


@dataclass(frozen=True)
class CampaignProvenance:
    """All artifacts of a campaign by their path under the results folder: headers, or those that are missing.

    `chain_problem` names the first that does not fit its inputs or the configuration, "" if all do; `costs` has
    one row of `stage_costs` per stage.
    """

    artifacts: dict[str, Header]
    missing: tuple[str, ...]
    chain_problem: str
    costs: list[dict[str, Any]]

    @property
    def commits(self) -> tuple[str, ...]:
        """Commits of the code that made the artifacts."""
        return tuple(sorted({header.git_commit for header in self.artifacts.values()}))

    @property
    def dirty(self) -> tuple[str, ...]:
        """Stages with artifacts of code that had changes that were not committed."""
        return tuple(dict.fromkeys(header.stage for header in self.artifacts.values() if header.git_dirty))

    @property
    def seconds(self) -> float:
        """Wall time of all artifacts together [s]."""
        return sum(header.wall_seconds for header in self.artifacts.values())


def read_provenance(results: Path, config: Config) -> CampaignProvenance:
    """Read the header of every artifact of a campaign and follow the chain from the posterior.

    Raises
    ------
    ArtifactError
        If an artifact cannot be read.
    """
    files = artifact_files(config)
    artifacts: dict[str, Header] = {}
    missing: list[str] = []
    problem = ""
    for record in walk(files, stage_digests(config), hashed=[results / SINGLE["abc"]]):
        name = record.path.relative_to(results).as_posix()
        if record.verdict == "missing":
            missing.append(name)
            continue
        if record.path in files:
            artifacts[name] = record.header or read_header(record.path, record.stage)
        if record.findings and not problem:
            problem = str(record.findings[0].to_error()).replace(f"{results}/", "")
    return CampaignProvenance(artifacts, tuple(missing), problem, stage_costs(artifacts, results / "benchmarks"))


def stage_costs(artifacts: Mapping[str, Header], benchmarks: Path) -> list[dict[str, Any]]:
    """Return what each stage cost: number of artifacts, sum and median of their wall times [s], peak memory [MiB].

    The memory is None where Snakemake did not record it.
    """
    seconds: dict[str, list[float]] = {}
    for header in artifacts.values():
        seconds.setdefault(header.stage, []).append(header.wall_seconds)
    return [
        {
            "stage": stage,
            "n_artifacts": len(each),
            "total_seconds": sum(each),
            "median_seconds": statistics.median(each),
            "peak_mib": peak_memory(benchmarks, stage),
        }
        for stage, each in seconds.items()
    ]


def peak_memory(benchmarks: Path, stage: str) -> float | None:
    """Return the largest resident memory [MiB] in the benchmark files of a stage; None without such a file."""
    peaks = []
    single = [benchmarks / Path(SINGLE[stage]).with_suffix(".tsv")] if stage in SINGLE else []
    for path in (benchmarks / f"{stage}.tsv", *single, *sorted((benchmarks / stage).glob("*.tsv"))):
        if path.is_file():
            with path.open(newline="", encoding="utf-8") as handle:
                for line in csv.DictReader(handle, delimiter="\t"):
                    text = line.get("max_rss") or ""
                    if text.replace(".", "", 1).isdigit():  # "NA" or "-" where it was not measured
                        peaks.append(float(text))
    return max(peaks, default=None)
