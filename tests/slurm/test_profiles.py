"""The same campaign on this machine, in one Slurm allocation, and as Slurm jobs: the same artifacts."""

from __future__ import annotations

import dataclasses
import os

import pytest

from ..workflow.conftest import Project
from .conftest import TARGET, Campaign

ONE_CHUNK = "results/tiny/summaries/chunk-0000000-0000007.h5"
# lens, operator and the chunk; also the observation's scan, the other chunk, the null test, abc
N_JOBS = {ONE_CHUNK: 3, TARGET: 6}


def test_one_allocation_gives_the_same_digests(local: Project, campaign: Campaign) -> None:
    log = campaign.run_in_one_allocation()
    assert "Provided cores: 2" in log
    assert 'Resource("mem_mb", 6144)' in log  # Snakemake keeps within the memory of the allocation
    assert campaign.project.digests() == local.digests()


@pytest.mark.parametrize("target", [TARGET if "WARMLENS_TEST_FAULTS" in os.environ else ONE_CHUNK])
def test_executor_gives_the_same_digests_and_shares_allocations(
    local: Project, campaign: Campaign, target: str
) -> None:
    """In CI up to the summaries of a chunk, with the faults up to the posterior."""
    before = len(campaign.cluster.finished())
    campaign = dataclasses.replace(campaign, target=target)
    campaign.run_with_executor("--group-components", "operator=2", "chunk=2")
    found, expected = campaign.project.digests(), local.digests()
    if target == TARGET:
        assert found == expected
    assert target.removeprefix("results/tiny/") in found
    assert found == {name: expected[name] for name in found}
    jobs = campaign.cluster.finished()[before:]
    assert len(jobs) == N_JOBS[target], jobs
    assert all("JobState=COMPLETED" in job and "Tres=cpu=1," in job for job in jobs), jobs
