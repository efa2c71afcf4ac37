"""The same campaign on this machine, in one Slurm allocation, and as Slurm jobs: the same artifacts."""

from __future__ import annotations

from ..workflow.conftest import Project
from .conftest import FROM_NOTHING, Campaign


def test_one_allocation_gives_the_same_digests(local: Project, campaign: Campaign) -> None:
    log = campaign.run_in_one_allocation()
    assert "Provided cores: 2" in log
    assert 'Resource("mem_mb", 6144)' in log  # Snakemake keeps within the memory of the allocation
    assert campaign.project.digests() == local.digests()


def test_executor_gives_the_same_digests_and_shares_allocations(local: Project, campaign: Campaign) -> None:
    before = len(campaign.cluster.finished())
    campaign.run_with_executor("--group-components", "operator=2", "chunk=2")
    assert campaign.project.digests() == local.digests()
    jobs = campaign.cluster.finished()[before:]
    # chunks, abc; from nothing also lens, operator, observed, null test
    assert len(jobs) == (6 if FROM_NOTHING else 2), jobs
    assert all("JobState=COMPLETED" in job and "Tres=cpu=1," in job for job in jobs), jobs
