from __future__ import annotations

from typing import Any

import pytest

from warmlens.config import Config
from warmlens.config_file import parse_config
from warmlens.stages.settings import STAGES, stage_digests, stage_settings


def _changed(config: Config, block: str, **values: Any) -> Config:
    raw = config.model_dump()
    raw[block].update(values)
    return parse_config(raw)


@pytest.mark.parametrize(
    ("block", "values", "stages"),
    [
        ("campaign", {"n_samples": 5000}, {"abc"}),
        ("campaign", {"seed": 2}, {"halos", "mocks", "abc"}),
        ("campaign", {"chunk_size": 100}, set()),
        ("redshifts", {"source": 0.7}, {"observation", "halos", "deflections", "abc"}),
        ("dark_matter", {"m_th_kev": (1.0, 10.0)}, {"halos", "abc"}),
        ("halos", {"preset": "calibrated"}, {"observation", "halos", "abc"}),
        ("deflections", {"filter_arcsec": 0.3}, {"observation", "deflections", "abc"}),
        ("deflections", {"filter": "starlet"}, {"observation", "deflections", "abc"}),
        ("deflections", {"smooth_host": True}, {"observation", "deflections", "abc"}),
        ("mocks", {"quasar_positions": "solved"}, {"mocks", "abc"}),
        ("smooth_model", {"ridge": 1e-7}, {"smooth_model", "abc"}),
        ("summaries", {"threshold": -5.0}, {"observed_summary", "summaries", "abc"}),
        ("abc", {"fraction": 0.1}, {"abc"}),
        (
            "scan",
            {"step_arcsec": 0.1},
            {
                "scan_design",
                "scan_operator",
                "observed_scan",
                "scans",
                "observed_summary",
                "summaries",
                "abc",
            },
        ),
    ],
)
def test_a_key_reaches_only_the_stages_that_read_it(
    paper_config: Config, block: str, values: dict[str, Any], stages: set[str]
) -> None:
    before, after = stage_digests(paper_config), stage_digests(_changed(paper_config, block, **values))
    assert {stage for stage in STAGES if before[stage] != after[stage]} == stages


def test_settings_survive_json(paper_config: Config) -> None:
    raw = paper_config.model_dump()
    raw["observation"]["simulated"]["truth"]["m_th_kev"] = float("inf")
    config = parse_config(raw)
    for stage in STAGES:
        settings = stage_settings(config, stage)
        assert type(settings).model_validate(settings.as_dict()) == settings


def test_unknown_stage(paper_config: Config) -> None:
    with pytest.raises(ValueError, match="unknown stage 'scan'"):
        stage_settings(paper_config, "scan")
