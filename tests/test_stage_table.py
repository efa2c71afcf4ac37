from __future__ import annotations

from importlib import import_module
from typing import Any

import pytest

from warmlens.config.file import parse_config
from warmlens.config.model import Config
from warmlens.stage_table import STAGES, campaign_stages, stage_digests, stage_settings


def _changed(config: Config, block: str, **values: Any) -> Config:
    raw = config.model_dump()
    raw[block].update(values)
    return parse_config(raw)


@pytest.mark.parametrize(
    ("block", "values", "stages"),
    [
        ("campaign", {"n_samples": 5000}, {"abc"}),
        ("campaign", {"seed": 2}, {"halos", "mocks", "null_mocks", "abc"}),
        ("null_test", {"n_mocks": 7}, {"null_mocks", "abc"}),
        ("scan", {"residual_samples": [3]}, {"scans", "abc"}),
        ("summaries", {"count_thresholds": [-6.0]}, {"observed_summary", "summaries", "null_summaries", "abc"}),
        ("abc", {"summaries": "learned"}, {"abc"}),
        ("campaign", {"chunk_size": 100}, set()),
        ("redshifts", {"source": 0.7}, {"observation", "halos", "deflections", "abc"}),
        ("dark_matter", {"m_th_kev": (1.0, 10.0)}, {"halos", "abc"}),
        ("halos", {"preset": "calibrated"}, {"observation", "halos", "abc"}),
        ("deflections", {"filter_arcsec": 0.3}, {"observation", "deflections", "abc"}),
        ("deflections", {"filter": "starlet"}, {"observation", "deflections", "abc"}),
        ("deflections", {"smooth_host": True}, {"observation", "deflections", "abc"}),
        ("mocks", {"quasar_positions": "solved"}, {"mocks", "abc"}),
        ("smooth_model", {"ridge": 1e-7}, {"smooth_model", "abc"}),
        ("summaries", {"threshold": -5.0}, {"observed_summary", "summaries", "null_summaries", "abc"}),
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
                "null_scans",
                "null_summaries",
                "abc",
            },
        ),
    ],
)
def test_a_key_reaches_only_the_stages_that_read_it(
    paper_config: Config, block: str, values: dict[str, Any], stages: set[str]
) -> None:
    before, after = stage_digests(paper_config), stage_digests(_changed(paper_config, block, **values))
    assert {stage for stage in before if before[stage] != after[stage]} == stages


def test_settings_survive_json(paper_config: Config) -> None:
    raw = paper_config.model_dump()
    raw["observation"]["simulated"]["truth"]["m_th_kev"] = float("inf")
    config = parse_config(raw)
    for stage in campaign_stages(config):
        settings = stage_settings(config, stage)
        assert type(settings).model_validate(settings.as_dict()) == settings


def test_every_input_of_a_stage_is_a_stage_before_it() -> None:
    """The table is a graph without circles, and every stage's code is there."""
    seen: list[str] = []
    for name, stage in STAGES.items():
        assert set(stage.inputs.values()) <= set(seen) | ({"summaries"} if name == "exclusion" else set()), name
        module, _, function = stage.work.partition(":")
        assert callable(getattr(import_module(f"warmlens.stages.{module}"), function))
        seen.append(name)


def test_unknown_stage(paper_config: Config) -> None:
    with pytest.raises(ValueError, match="unknown stage 'scan'"):
        stage_settings(paper_config, "scan")


def test_a_grid_reaches_the_halos_and_what_depends_on_them(paper_config: Config) -> None:
    raw = paper_config.model_dump()
    grid = {"m_th_kev": [1.0, 5.0], "log10_m_halo_msun": [13.0, 13.5], "realizations": 3}
    raw["campaign"].update(design="grid", n_samples=12, grid=grid)
    config = parse_config(raw)
    before, after = stage_digests(paper_config), stage_digests(config)
    assert set(after) == {stage for stage in STAGES if stage != "abc" and "null" not in stage}
    assert {stage for stage in after if before.get(stage) != after[stage]} == {"halos", "exclusion"}
    raw["campaign"].update(n_samples=20, grid={**grid, "realizations": 5})
    more = stage_digests(parse_config(raw))
    assert {stage for stage in more if more[stage] != after[stage]} == {"exclusion"}  # the samples stay
    raw["dark_matter"]["m_th_kev"] = (1.0, 7.0)
    assert stage_digests(parse_config(raw))["halos"] == after["halos"]  # the prior is not drawn from
    settings = stage_settings(config, "halos")
    assert type(settings).model_validate(settings.as_dict()) == settings
    with pytest.raises(ValueError, match=r"'exclusion' belongs to campaign\.design: grid"):
        stage_settings(paper_config, "exclusion")


def test_unused_kinds_of_observation_leave_the_settings_alone(paper_config: Config) -> None:
    """Else every campaign would make its observation, and all that follows, again."""
    settings = stage_settings(paper_config, "observation").as_dict()
    assert settings["observation"].keys() == {"kind", "bands", "simulated", "fits"}
    taken = _changed(paper_config, "observation", kind="artifact", artifact="results/other/observation.h5")
    settings = stage_settings(taken, "observation").as_dict()
    assert settings["observation"]["artifact"] == "results/other/observation.h5"
    assert settings["observation"]["simulated"] is settings["halos"] is None
