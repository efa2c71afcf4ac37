"""Killed and timed-out Slurm jobs: the next start ends with the artifacts of an undisturbed campaign."""

from __future__ import annotations

import os
import signal

from warmlens.artifacts.names import CHUNKED

from ..reliability import Outcome, fault
from ..workflow.conftest import Project
from .conftest import Campaign

N_CHUNK_FILES = 2 * len(CHUNKED)


def _is_unfinished(campaign: Campaign) -> bool:
    return 0 < len(list(campaign.project.results.rglob("chunk-*.h5"))) < N_CHUNK_FILES


@fault("Slurm", "an allocation is killed outright", "SIGKILL to all its processes, a scan at work")
def test_killed_allocation_is_submitted_again(local: Project, half_done: Campaign, outcome: Outcome) -> None:
    job = half_done.submit()
    half_done.worker("scans")
    for process in half_done.cluster.processes(job):  # Snakemake, what it runs and the script, without warning
        process.kill()
    assert half_done.cluster.end_of(job) == "FAILED"
    assert _is_unfinished(half_done)
    assert "the last job was killed; its lock is removed" in half_done.run_in_one_allocation()
    outcome.same_digests(
        half_done.project.digests(), local.digests(), lost="the job in flight", after="the script submitted again"
    )


@fault("Slurm", "the wall time is near", "SIGTERM to the batch script, as Slurm sends it")
def test_allocation_is_told_before_the_wall_time(local: Project, half_done: Campaign, outcome: Outcome) -> None:
    job, following = half_done.submit(), half_done.submit()
    half_done.worker("deflections")
    cluster = half_done.cluster
    assert cluster.state(following) == "PENDING", "two jobs of one campaign run at a time"
    cluster.command("scancel", "--batch", "--signal=TERM", job)  # what --signal=B:TERM@600 sends
    assert cluster.end_of(job) == "FAILED"
    assert "stopped at the wall time, finished artifacts are kept: submit it again" in half_done.log(job)
    assert _is_unfinished(half_done)
    assert cluster.end_of(following) == "COMPLETED", half_done.log(following)
    assert "lock" not in half_done.log(following)
    outcome.same_digests(half_done.project.digests(), local.digests(), after="the next submission went on")


@fault("Slurm", "a job hangs until the wall time", "SIGSTOP to a scan, time limit of a minute")
def test_hanging_allocation_ends_at_the_wall_time(local: Project, half_done: Campaign, outcome: Outcome) -> None:
    job = half_done.submit("--signal=B:TERM@20")
    half_done.worker("scans").send_signal(signal.SIGSTOP)
    half_done.cluster.command("scontrol", "update", f"JobId={job}", "TimeLimit=1")
    assert half_done.cluster.end_of(job) == "TIMEOUT"
    assert "the wall time is near: no new jobs" in half_done.log(job)
    assert "finished artifacts are kept: submit it again" in half_done.log(job)
    assert _is_unfinished(half_done)
    half_done.run_in_one_allocation()
    outcome.same_digests(
        half_done.project.digests(), local.digests(), lost="the job in flight", after="the script submitted again"
    )


@fault("Slurm", "the Snakemake that submits is killed", "SIGKILL, Slurm's jobs at work")
def test_killed_submitter_leaves_jobs_to_cancel(local: Project, half_done: Campaign, outcome: Outcome) -> None:
    process = half_done.start_with_executor()
    half_done.worker("mocks")
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    cluster = half_done.cluster
    assert cluster.queue(), "Slurm's jobs go on without the Snakemake that submitted them"
    log = (half_done.project.folder / "executor.log").read_text()
    cluster.command("scancel", f"--name={log.partition('SLURM run ID: ')[2].split()[0]}")
    cluster.wait_for(lambda: not cluster.queue(), "the cancelled jobs to end")
    half_done.run_with_executor("--unlock")
    half_done.run_with_executor()
    outcome.same_digests(
        half_done.project.digests(),
        local.digests(),
        lost="the jobs in flight",
        after="scancel, --unlock, started again",
    )


@fault("Slurm", "a Slurm job reaches its wall time", "SIGSTOP to a scan, time limit of a minute, profile slurm")
def test_job_at_its_wall_time_is_tried_again(local: Project, half_done: Campaign, outcome: Outcome) -> None:
    process = half_done.start_with_executor()
    worker = half_done.worker("scans")
    worker.send_signal(signal.SIGSTOP)
    job = worker.environ()["SLURM_JOB_ID"]
    half_done.cluster.command("scontrol", "update", f"JobId={job}", "TimeLimit=1")
    assert half_done.cluster.end_of(job) == "TIMEOUT"
    assert process.wait() == 0
    assert "DUE TO TIME LIMIT" in (half_done.project.folder / "executor.log").read_text()
    outcome.same_digests(half_done.project.digests(), local.digests(), lost="the job in flight")
