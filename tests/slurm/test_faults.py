"""Killed and timed-out Slurm jobs: the next start ends with the artifacts of an undisturbed campaign."""

from __future__ import annotations

import os
import signal

import pytest

from warmlens.layout import CHUNKED

from ..workflow.conftest import Project
from .conftest import ASKED_FOR, Campaign

pytestmark = pytest.mark.skipif(
    ASKED_FOR != "all", reason="kills a real Slurm's jobs; run `make test-slurm` as root"
)
N_CHUNK_FILES = 2 * len(CHUNKED)


def _is_unfinished(campaign: Campaign) -> bool:
    return 0 < len(list(campaign.project.results.rglob("chunk-*.h5"))) < N_CHUNK_FILES


def test_killed_allocation_is_submitted_again(local: Project, half_done: Campaign) -> None:
    job = half_done.submit()
    half_done.worker("scans")
    for process in half_done.cluster.processes(job):  # Snakemake, what it runs and the script, without warning
        process.kill()
    assert half_done.cluster.end_of(job) == "FAILED"
    assert _is_unfinished(half_done)
    assert "the last job was killed; its lock is removed" in half_done.run_in_one_allocation()
    assert half_done.project.digests() == local.digests()


def test_allocation_is_told_before_the_wall_time(local: Project, half_done: Campaign) -> None:
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
    assert half_done.project.digests() == local.digests()


def test_hanging_allocation_ends_at_the_wall_time(local: Project, half_done: Campaign) -> None:
    job = half_done.submit("--signal=B:TERM@20")
    half_done.worker("scans").send_signal(signal.SIGSTOP)
    half_done.cluster.command("scontrol", "update", f"JobId={job}", "TimeLimit=1")
    assert half_done.cluster.end_of(job) == "TIMEOUT"
    assert "the wall time is near: no new jobs" in half_done.log(job)
    assert "finished artifacts are kept: submit it again" in half_done.log(job)
    assert _is_unfinished(half_done)
    half_done.run_in_one_allocation()
    assert half_done.project.digests() == local.digests()


def test_killed_submitter_leaves_jobs_to_cancel(local: Project, half_done: Campaign) -> None:
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
    assert half_done.project.digests() == local.digests()


def test_job_at_its_wall_time_is_tried_again(local: Project, half_done: Campaign) -> None:
    process = half_done.start_with_executor()
    worker = half_done.worker("scans")
    worker.send_signal(signal.SIGSTOP)
    job = worker.environ()["SLURM_JOB_ID"]
    half_done.cluster.command("scontrol", "update", f"JobId={job}", "TimeLimit=1")
    assert half_done.cluster.end_of(job) == "TIMEOUT"
    assert process.wait() == 0
    assert "DUE TO TIME LIMIT" in (half_done.project.folder / "executor.log").read_text()
    assert half_done.project.digests() == local.digests()
