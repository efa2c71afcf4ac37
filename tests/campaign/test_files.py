"""Names of a campaign's files, and the window that they depend on."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from warmlens.campaign.files import resolve_window, shards, stage_file, stage_inputs
from warmlens.config.file import parse_config
from warmlens.config.model import Config
from warmlens.config.types import ConfigError
from warmlens.imaging.grid import PixelGrid
from warmlens.physics import scan_raster
from warmlens.products import images
from warmlens.scan.raster import Raster


def test_a_window_of_null_becomes_that_of_the_unmasked_pixels(
    paper_config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The box around the pixels that any band uses, written into the configuration to the last bit."""
    masks = {name: np.zeros((32, 30), dtype=bool) for name in ("F814W", "F555W")}
    masks["F814W"][4:20, 6:26] = masks["F555W"][20:24, 6:8] = True
    bands = [SimpleNamespace(name=name, mask=mask) for name, mask in masks.items()]
    observed = SimpleNamespace(grid=PixelGrid.centred((32, 30), 0.05), bands=bands)
    monkeypatch.setattr(images, "artifact_path", lambda _: Path("observation.h5"))
    monkeypatch.setattr(images, "read_observation", lambda _: observed)
    raw = paper_config.model_dump()
    raw["observation"] |= {"kind": "artifact", "artifact": "observation.h5"}
    raw["scan"] |= {"window_arcsec": None, "step_arcsec": 0.3}
    config = parse_config(raw)
    with pytest.raises(ConfigError, match=r"scan\.window_arcsec: null until the campaign starts"):
        shards(config)
    resolved = resolve_window(config)
    raster = Raster.around(masks["F814W"] | masks["F555W"], observed.grid, 0.3)
    assert raster.shape == (round(20 * 0.05 / 0.3), round(20 * 0.05 / 0.3))
    assert scan_raster(resolved.scan) == raster
    assert parse_config(json.loads(resolved.model_dump_json())) == resolved
    assert resolve_window(resolved) is resolved


def test_inputs_of_a_chunk_are_those_of_its_samples(paper_config: Config) -> None:
    inputs = stage_inputs(paper_config, "scans", (250, 500))
    assert inputs["mocks"] == Path("results/paper/mocks/chunk-0000250-0000500.h5")
    assert inputs["design"] == Path("results/paper/scan_operator/design.h5")
    assert len(inputs["shards"]) == len(shards(paper_config))
    assert stage_file(paper_config, "scans", (250, 500)).name == "chunk-0000250-0000500.h5"
    assert len(stage_inputs(paper_config, "abc")["summaries"]) == 10
    off = paper_config.model_copy(update={"null_test": paper_config.null_test.model_copy(update={"n_mocks": 0})})
    assert "null_summaries" in stage_inputs(paper_config, "abc") and "null_summaries" not in stage_inputs(
        off, "abc"
    )
