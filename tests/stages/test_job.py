"""A run of a stage: what it needs is checked before anything is computed."""

from __future__ import annotations

from pathlib import Path

import pytest

from warmlens.config.model import Config
from warmlens.config.types import ConfigError
from warmlens.stage_table import stage_settings
from warmlens.stages.job import make_job


def test_inputs_are_recorded_by_name(paper_config: Config) -> None:
    settings = stage_settings(paper_config, "scans")
    shards = [Path("shard-0000000-0000008.h5"), Path("shard-0000008-0000016.h5")]
    single = {name: Path(f"{name}.h5") for name in ("mocks", "observation", "smooth_model", "design")}
    job = make_job("scans", settings, Path("scans.h5"), {**single, "shards": shards})
    assert job.path("mocks") == Path("mocks.h5") and job.paths("shards") == shards
    assert job.sources == {**single, **{f"shards/{path.stem}": path for path in shards}}
    one = make_job("scans", settings, Path("scans.h5"), {**single, "shards": shards[:1]})
    assert one.paths("shards") == shards[:1]


def test_only_the_null_test_may_be_missing(paper_config: Config) -> None:
    settings = stage_settings(paper_config, "abc")
    files = {name: Path(f"{name}.h5") for name in ("observed_summary", "smooth_model", "summaries")}
    assert make_job("abc", settings, Path("abc.h5"), files).paths("null_summaries") == []
    for name in files:
        with pytest.raises(ConfigError, match=f"stage abc: needs --input {name}=FILE of stage {name}, got 0"):
            make_job("abc", settings, Path("abc.h5"), {key: path for key, path in files.items() if key != name})


def test_what_is_missing_or_superfluous_is_named(paper_config: Config) -> None:
    settings = stage_settings(paper_config, "scan_operator")
    files = {name: Path(f"{name}.h5") for name in ("observation", "smooth_model", "design", "mocks")}
    with pytest.raises(ConfigError) as error:
        make_job("scan_operator", settings, Path("shard.h5"), files)
    assert error.value.problems == [
        "stage scan_operator: has no input mocks; its inputs are observation, smooth_model, design",
        "stage scan_operator: needs --span START STOP, the samples or positions to compute",
    ]
    two = {"observation": [Path("a.h5"), Path("b.h5")]}
    with pytest.raises(ConfigError, match="observation=FILE of stage observation, got 2"):
        make_job("smooth_model", stage_settings(paper_config, "smooth_model"), Path("model.h5"), two)
