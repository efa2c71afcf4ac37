"""Fixtures that several folders share."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from warmlens import runtime
from warmlens.config.file import load_config
from warmlens.config.model import Config

from .reliability import Recorder, outcome

__all__ = ["outcome"]  # a fixture

ROOT = Path(__file__).parents[1]


def pytest_configure(config: pytest.Config) -> None:
    runtime.prepare()  # before the tests import anything numerical
    config.pluginmanager.register(Recorder())


_ORDER = (
    "slurm/",  # waits most of the time
    "workflow/test_campaign.py::test_campaign_is_complete",  # runs the campaign of all, and compiles the kernels
    # need no kernels, or not many: not to wait for it meanwhile
    *("inference/", "security/", "summaries/", "figures/draw/", "science/test_inference", "stages/test_abc.py"),
    *("workflow/", "docs/"),  # long, each of them
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Campaigns first, which take longest, but for what can be done while the first of them runs."""

    def place(item: pytest.Item) -> int:
        name = item.nodeid.removeprefix("tests/")
        return next((i for i, start in enumerate(_ORDER) if name.startswith(start)), len(_ORDER))

    items.sort(key=place)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One process more than cores: the one with Slurm waits most of the time."""
    return len(os.sched_getaffinity(0)) + 1


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """With several processes a file stays in one of them, but for campaigns, each of which is long."""
    from xdist.scheduler import LoadScopeScheduling

    class ByFixtures(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            path = nodeid.partition("::")[0]
            share_a_fixture = path.endswith(("test_report.py", "test_damage.py"))
            return nodeid if "workflow/" in path and not share_a_fixture else path

    return ByFixtures(config, log)


@pytest.fixture(scope="session")
def paper_config() -> Config:
    """The configuration of the paper."""
    return load_config([ROOT / "config.yaml"])


@pytest.fixture(scope="session")
def paper_lens(paper_config: Config) -> tuple[list[str], list[dict[str, Any]]]:
    """Default lens without its potential shapelets, in lenstronomy's names and kwargs."""
    lens = paper_config.smooth_model.lens
    return lens.lens_model_list[:3], lens.kwargs_lens[:3]
