"""Fixtures that several folders share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from warmlens import runtime
from warmlens.config import Config
from warmlens.config_file import load_config

ROOT = Path(__file__).parents[1]


def pytest_configure() -> None:
    runtime.prepare()  # before the tests import anything numerical


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """With several processes, a file stays in one of them; tests of the workflow share a campaign, and begin."""
    items.sort(key=lambda item: "workflow" not in item.path.parts)
    for item in items:
        group = "workflow" if "workflow" in item.path.parts else str(item.path.relative_to(ROOT))
        item.add_marker(pytest.mark.xdist_group(group))


@pytest.fixture(scope="session")
def paper_config() -> Config:
    """The configuration of the paper."""
    return load_config([ROOT / "config.yaml"])


@pytest.fixture(scope="session")
def paper_lens(paper_config: Config) -> tuple[list[str], list[dict[str, Any]]]:
    """Default lens without its potential shapelets, in lenstronomy's names and kwargs."""
    lens = paper_config.smooth_model.lens
    return lens.lens_model_list[:3], lens.kwargs_lens[:3]
