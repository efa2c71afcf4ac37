"""The same campaign on this machine, in one Slurm allocation, and as Slurm jobs: the same artifacts."""

from __future__ import annotations

import dataclasses

from ..workflow.conftest import Project
from .conftest import Campaign

ONE_CHUNK = "results/tiny/summaries/chunk-0000000-0000007.h5"


def test_one_allocation_gives_the_same_digests(local: Project, campaign: Campaign) -> None:
    log = campaign.run_in_one_allocation()
    assert "Provided cores: 2" in log
    assert 'Resource("mem_mb", 6144)' in log  # Snakemake keeps within the memory of the allocation
    assert campaign.project.digests() == local.digests()


def test_executor_gives_the_same_digests_and_shares_allocations(local: Project, campaign: Campaign) -> None:
    """Up to the summaries of a chunk; tests of faults go on to the posterior."""
    before = len(campaign.cluster.finished())
    campaign = dataclasses.replace(campaign, target=ONE_CHUNK)
    campaign.run_with_executor("--group-components", "operator=2", "chunk=2")
    found = campaign.project.digests()
    assert ONE_CHUNK.removeprefix("results/tiny/") in found
    assert found == {name: digest for name, digest in local.digests().items() if name in found}
    jobs = campaign.cluster.finished()[before:]
    assert len(jobs) == 3, jobs  # lens, operator, the chunk
    assert all("JobState=COMPLETED" in job and "Tres=cpu=1," in job for job in jobs), jobs
