"""Where the core seconds of a finished campaign went, and what fraction workflow and artifacts cost.

python benchmarks/workflow.py --results results/x --cores 2 [--json FILE]

The campaign must have been made in one go. Its wall time runs from the configuration, which Snakemake writes at
its start, to the last file; the start of Snakemake before that is timed by a dry run. A job's seconds are those of
its benchmark file, a stage's own those of its artifact: the difference is process start, imports and exit.
Writing, hashing and reading are timed by doing each again, the file's pages in memory as when a stage reads what
another has just written; `sensitivity` is not read where no residual maps are asked for, as in the scans.
"""

from __future__ import annotations

import argparse
import csv
import json
import shlex
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.chain import input_paths
from warmlens.artifacts.file import Dataset, content_digest, open_artifact, read_header
from warmlens.artifacts.names import CONFIG, CRATE, MANIFEST
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.campaign.derived import derived_files
from warmlens.campaign.files import artifact_files
from warmlens.campaign.snakemake import SNAKEMAKE, remaking_command
from warmlens.campaign.status import read_campaign
from warmlens.config.model import Config

TARGET = 0.05


@dataclass(frozen=True)
class Parts:
    """Core seconds of a campaign.

    Attributes
    ----------
    science
        Work of the stages, without their artifacts.
    pages
        Figures, report and manifest, whole processes.
    starts
        Starts of processes, imports, and their ends.
    writing, hashing, reading
        Of artifacts; hashing is not part of writing.
    engine
        Start of Snakemake, on every core.
    idle
        Cores without a job: Snakemake between jobs, and jobs that wait for others.
    """

    science: float
    pages: float
    starts: float
    writing: float
    hashing: float
    reading: float
    engine: float
    idle: float

    @property
    def overhead(self) -> float:
        """Fraction of all core seconds that is neither science nor pages nor waiting."""
        spent = self.starts + self.writing + self.hashing + self.reading + self.engine
        return spent / self.total

    @property
    def overhead_and_idle(self) -> float:
        """The same with every idle core second counted as overhead."""
        return self.overhead + self.idle / self.total

    @property
    def total(self) -> float:
        """All of them."""
        return sum(asdict(self).values())


def job_seconds(folder: Path) -> dict[str, float]:
    """Wall seconds of every job by the path of its benchmark file, the last run of each."""
    found = {}
    for path in sorted(folder.rglob("*.tsv")):
        with path.open(newline="") as handle:
            rows = list(csv.DictReader(handle, delimiter="\t"))
        found[path.relative_to(folder).with_suffix("").as_posix()] = float(rows[-1]["s"])
    return found


def time_artifact(path: Path, scratch: Path, *, sensitivity: bool) -> tuple[float, float, float]:
    """Seconds of writing without hashing, of hashing, and of reading an artifact once."""
    with open_artifact(path) as artifact:
        stage, settings, metadata = artifact.stage, artifact.settings, dict(artifact.metadata)
        datasets: dict[str, Dataset] = {name: artifact.dataset(name) for name in artifact.names}
    copy = scratch / "copy.h5"
    began = time.perf_counter()
    write_artifact(copy, Provenance(stage, settings), datasets, metadata)
    written = time.perf_counter() - began
    del datasets
    with open_artifact(copy) as artifact:
        began = time.perf_counter()
        content_digest(artifact.file, artifact.metadata)
        hashed = time.perf_counter() - began
    copy.unlink()
    began = time.perf_counter()
    with open_artifact(path) as artifact:
        for name in artifact.names:
            if sensitivity or not name.endswith("/sensitivity"):
                artifact.dataset(name)
    return written - hashed, hashed, time.perf_counter() - began


def measure(config: Config, cores: int, engine: float) -> Parts:
    """Where the core seconds of the campaign went; `engine` seconds is the start of Snakemake."""
    results = Path(config.results)
    artifacts = artifact_files(config)
    made = (*artifacts, *derived_files(config), results / MANIFEST, results / CRATE)
    files = [path for path in made if path.name != CONFIG]
    started = (results / CONFIG).stat().st_mtime
    old = [path for path in files if path.stat().st_mtime < started]
    if old:
        raise ArtifactError(f"{old[0]}: older than {CONFIG}; the campaign was not made in one go: run it anew")
    wall = max(path.stat().st_mtime for path in files) - started
    own, readers = 0.0, Counter[Path]()
    for path, stage in artifacts.items():
        header = read_header(path, stage)
        own += header.wall_seconds
        if stage != "observation":
            readers.update(set(input_paths(header).values()))
    writing = hashing = reading = 0.0
    sensitivity = bool(config.scan.residual_samples)
    with tempfile.TemporaryDirectory(dir=results.parent) as scratch:
        for path in artifacts:
            w, h, r = time_artifact(path, Path(scratch), sensitivity=sensitivity)
            writing, hashing, reading = writing + w, hashing + h, reading + r * readers[path]
    jobs = job_seconds(results / "benchmarks")
    pages = sum(jobs[name] for name in jobs if name.startswith(("figures/", "report", "manifest")))
    stages = sum(jobs.values()) - pages
    return Parts(
        science=own - writing - hashing - reading,
        pages=pages,
        starts=stages - own,
        writing=writing,
        hashing=hashing,
        reading=reading,
        engine=engine * cores,
        idle=cores * wall - stages - pages,
    )


def engine_start(results: Path) -> float:
    """Seconds of a dry run of the finished campaign: reading the workflow, and finding that all is there."""
    words = shlex.split(remaking_command(results))[1:]
    began = time.perf_counter()
    subprocess.run([SNAKEMAKE, *words, "--dry-run", "--quiet"], check=True, capture_output=True)
    return time.perf_counter() - began


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", type=Path, required=True, help="as the campaign names it, from its folder")
    parser.add_argument("--cores", type=int, required=True, help="that it was run on")
    parser.add_argument("--run", nargs="*", metavar="OVERLAY", help="run it first, with these overlays")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    if options.run is not None:
        overlays = [word for overlay in options.run for word in ("--configfile", overlay)]
        warmlens = str(Path(SNAKEMAKE).with_name("warmlens"))
        subprocess.run([warmlens, "run", *overlays, "--cores", str(options.cores)], check=True)
    parts = measure(read_campaign(options.results), options.cores, engine_start(options.results))
    for name, seconds in asdict(parts).items():
        print(f"{name:10s} {seconds:10.1f} core s  {seconds / parts.total:6.1%}")
    print(
        f"overhead   {parts.overhead:.1%} of {parts.total:.0f} core s (target {TARGET:.0%}), with idle cores ",
        end="",
    )
    print(f"{parts.overhead_and_idle:.1%}")
    if options.json:
        numbers = {**asdict(parts), "overhead": parts.overhead, "overhead_and_idle": parts.overhead_and_idle}
        options.json.write_text(json.dumps(numbers, indent=2) + "\n")


if __name__ == "__main__":
    main()
