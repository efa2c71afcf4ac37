"""Time and memory of each stage of a finished campaign, whether it grows in proportion, and what more would cost.

python benchmarks/scaling.py results/paper_cold --samples 250 500 1000 2483 [--json FILE]

Read from the benchmark files that Snakemake writes for every job; chunks count in the order of their samples, so a
campaign that was extended step by step, or made in one go, says the same.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warmlens.artifacts.names import CHUNKED

LARGER = (10_000, 100_000, 1_000_000)
_CHUNK = re.compile(r"(\d{7})-(\d{7})")


@dataclass(frozen=True)
class Job:
    """One job: its stage, its samples (None of a stage that has none), wall seconds and peak memory [GB].

    Memory is NaN of a job that ended before Snakemake looked.
    """

    stage: str
    samples: tuple[int, int] | None
    seconds: float
    memory_gb: float


def read_jobs(folder: Path) -> list[Job]:
    """All jobs of a campaign, from its folder of benchmark files."""
    jobs = []
    for path in sorted(folder.rglob("*.tsv")):
        with path.open(newline="") as handle:
            row = list(csv.DictReader(handle, delimiter="\t"))[-1]
        stage, _, rest = path.relative_to(folder).with_suffix("").as_posix().partition("/")
        span = _CHUNK.fullmatch(rest)
        samples = (int(span[1]), int(span[2])) if span and stage in CHUNKED else None
        memory = float(row["max_rss"]) / 1024.0 if row["max_rss"] not in ("-", "NA") else math.nan
        jobs.append(Job(stage, samples, float(row["s"]), memory))
    if not jobs:
        raise SystemExit(f"{folder}: no benchmark files; run the campaign, which writes them")
    for stage in CHUNKED:
        spans = sorted(job.samples for job in jobs if job.stage == stage and job.samples is not None)
        if [start for start, _ in spans] != [0, *(stop for _, stop in spans[:-1])]:
            raise SystemExit(f"{folder / stage}: chunks have gaps or overlap, as of an older chunk_size: {spans}")
    return jobs


def fixed_seconds(jobs: Sequence[Job]) -> float:
    """Core seconds of everything that is made once a campaign."""
    return sum(job.seconds for job in jobs if job.samples is None)


def seconds_up_to(jobs: Sequence[Job], n_samples: int) -> float:
    """Core seconds of the stages of the first samples; of a chunk that lies across the end, its share."""
    total = 0.0
    for job in jobs:
        if job.samples is not None:
            start, stop = job.samples
            total += job.seconds * float(np.clip((n_samples - start) / (stop - start), 0.0, 1.0))
    return total


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path)
    parser.add_argument("--samples", type=int, nargs="+", required=True, help="totals to compare")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    jobs = read_jobs(options.results / "benchmarks")
    made = min(max(job.samples[1] for job in jobs if job.stage == stage and job.samples) for stage in CHUNKED)
    if max(options.samples) > made or min(options.samples) < 1:
        parser.error(f"--samples must be from 1 to the {made} that {options.results} has, got {options.samples}")

    print("| stage | jobs | core minutes | peak memory [GB] |")
    print("| --- | --- | --- | --- |")
    stages = {}
    for stage in dict.fromkeys(job.stage for job in jobs):
        own = [job for job in jobs if job.stage == stage]
        minutes, memory = sum(job.seconds for job in own) / 60.0, [job.memory_gb for job in own]
        peak = max((gb for gb in memory if not math.isnan(gb)), default=None)
        stages[stage] = {"jobs": len(own), "core_minutes": minutes, "memory_gb": peak}
        print(f"| {stage} | {len(own)} | {minutes:.1f} | {'not measured' if peak is None else f'{peak:.1f}'} |")
    fixed = fixed_seconds(jobs)
    print(f"\nmade once: {fixed / 60.0:.1f} core minutes\n")

    print("| samples | core minutes after what is made once | core seconds a sample |")
    print("| --- | --- | --- |")
    grown = {n: seconds_up_to(jobs, n) for n in options.samples}
    for n, seconds in grown.items():
        print(f"| {n:,} | {seconds / 60.0:.1f} | {seconds / n:.3f} |")
    rates = [seconds / n for n, seconds in grown.items()]
    rate = rates[-1]
    print(f"\nthe rates differ by {max(rates) / min(rates) - 1.0:.1%}\n")
    for n in LARGER:
        print(f"{n:>9,} samples: {(fixed + rate * n) / 3600.0:8.1f} core hours")
    if options.json:
        numbers = {"stages": stages, "fixed_s": fixed, "samples_s": grown}
        options.json.write_text(json.dumps(numbers, indent=2) + "\n")


if __name__ == "__main__":
    main()
