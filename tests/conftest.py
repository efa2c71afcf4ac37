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


@pytest.fixture(scope="session")
def paper_config() -> Config:
    """The configuration of the paper."""
    return load_config([ROOT / "config.yaml"])


@pytest.fixture(scope="session")
def paper_lens(paper_config: Config) -> tuple[list[str], list[dict[str, Any]]]:
    """Default lens without its potential shapelets, in lenstronomy's names and kwargs."""
    lens = paper_config.smooth_model.lens
    return lens.lens_model_list[:3], lens.kwargs_lens[:3]
