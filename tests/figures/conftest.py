"""A small campaign whose stages have run one after another in this process, for figures to be drawn of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pandas as pd
import pytest
from matplotlib.axes import Axes

from warmlens.artifacts.names import CONFIG
from warmlens.campaign.files import campaign_job, chunks, shards, stage_files
from warmlens.config.file import load_config, parse_config
from warmlens.config.model import Config
from warmlens.figures import registry
from warmlens.figures.draw.style import house_style
from warmlens.stage_table import STAGES, campaign_stages
from warmlens.stages.job import run_job

from ..shared import shared_folder

ROOT = Path(__file__).parents[2]
SMALL: dict[str, dict[str, Any]] = {
    "campaign": {"n_samples": 40, "chunk_size": 20},
    "halos": {"preset": "calibrated", "field_half_width_arcsec": 3.0, "min_mass_msun": 1e8},
    "scan": {
        "step_arcsec": 0.5,
        "window_arcsec": (3.5, 4.0),
        "shard_size": 100,
        "residual_samples": [3, 25],
        "statistics": ["delta_r", "amplitude"],
    },
    "summaries": {"max_separation_arcsec": 2.4},
    "null_test": {"n_mocks": 0},
    "abc": {"fraction": 0.3, "bootstrap": 100, "leave_one_out": 40},
}


def small_config(paper_config: Config, results: Path) -> Config:
    """The paper's configuration, coarse."""
    raw = load_config([ROOT / "config.yaml", ROOT / "workflow/configs/ci.yaml"]).model_dump()
    for block, changes in SMALL.items():
        raw[block].update(changes)
    raw["results"] = str(results)
    raw["observation"]["simulated"]["shape"] = (64, 64)
    raw["observation"]["simulated"]["psf_pixels"] = 21
    raw["smooth_model"].update(mode="given", allow_poor_fit=True)
    raw["smooth_model"]["source"].update(n_max=6, clumps=None)
    return parse_config(raw)


@pytest.fixture(scope="session")
def campaign(paper_config: Config, tmp_path_factory: pytest.TempPathFactory) -> Config:
    """A finished campaign of 40 samples in two chunks; read it, do not change it."""
    with shared_folder(tmp_path_factory, "campaign_of_figures") as folder:
        config = small_config(paper_config, folder)
        if not stage_files(config, "abc")[0].exists():
            _run(config)
    return config


def _run(config: Config) -> None:
    (Path(config.results) / CONFIG).write_text(config.model_dump_json())

    for stage in campaign_stages(config):
        row = STAGES[stage]
        spans = shards(config) if row.by_position else chunks(config) if row.by_sample else [None]
        for span in spans if stage_files(config, stage) else []:
            run_job(campaign_job(config, stage, span))


@pytest.fixture(scope="session")
def table_of(campaign: Config, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], pd.DataFrame]:
    """CSV of a figure of the campaign, drawn at most once; the picture lies beside it."""
    folder = tmp_path_factory.mktemp("figures")

    def read(name: str) -> pd.DataFrame:
        picture = folder / f"{name}.png"
        if not picture.exists():
            registry.write_from_results(name, [Path(campaign.results)], picture)
        assert picture.read_bytes().startswith(b"\x89PNG")
        return pd.read_csv(picture.with_suffix(".csv"))

    return read


@pytest.fixture
def panel() -> Iterator[Axes]:
    """One panel in the house style, which can be rendered with all that a test puts on it."""
    with house_style():
        figure, ax = plt.subplots()
        yield ax
        figure.canvas.draw()
        plt.close(figure)
