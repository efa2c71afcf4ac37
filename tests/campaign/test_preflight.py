"""What `warmlens validate` finds in the images before anything runs."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from typing import Any

import pytest

from warmlens.campaign.preflight import check_observation, describe_grid
from warmlens.config.file import ConfigError, load_config
from warmlens.config.model import Config
from warmlens.imaging.grid import PixelGrid

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The simulated lens of docs/own_lens.md as FITS files."""
    path = tmp_path_factory.mktemp("lens")
    runpy.run_path(str(ROOT / "docs/examples/simulate_lens.py"))["write"](path)
    return path


@pytest.fixture
def config(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Config:
    monkeypatch.setenv("OWN_LENS", str(folder))
    return load_config([ROOT / "config.yaml", ROOT / "docs/examples/own_lens.yaml"])


def changed(config: Config, block: str, **values: Any) -> Config:
    return config.model_copy(update={block: getattr(config, block).model_copy(update=values)})


def test_orientation_and_quasars_are_told(config: Config) -> None:
    grid, *quasars = check_observation(config)
    assert "74 x 74 pixels of 0.0800 arcsec; origin at pixel [x, y] = [38.3, 34.6]" in grid
    assert "north 35.0 degrees clockwise from up, east to its left" in grid
    assert len(quasars) == 4
    assert not any("FAR" in line for line in quasars)


def test_positions_to_the_east_are_far_from_the_light(config: Config) -> None:
    mirrored = [(-x, y) for x, y in config.smooth_model.quasar_images]
    lines = check_observation(changed(config, "smooth_model", quasar_images=mirrored))
    assert sum("FAR" in line for line in lines) >= 3


def test_correlated_noise_is_told(config: Config) -> None:
    """The simulated lens has independent pixels: next to no correlation, and the sky's rms as it was made."""
    assert config.observation.fits is not None
    block = config.observation.fits["F140W"].model_copy(update={"blank_sky_arcsec": 2.0})
    *_, noise = check_observation(changed(config, "observation", fits={"F140W": block}))
    found = re.search(
        r"F140W: the noise of neighbouring pixels correlates by (\S+) along rows, (\S+) along columns, (\S+) "
        r"across; mocks have the same \(\d+ pixels of sky, rms (\S+) e-/s; taken: (\S+)\)",
        noise,
    )
    assert found is not None, noise
    row, column, across, rms, taken = map(float, found.groups())
    assert max(abs(row), abs(column), abs(across)) < 0.1
    assert rms == pytest.approx(taken, rel=0.1)


def test_every_problem_is_a_line(config: Config) -> None:
    wrong = changed(config, "smooth_model", quasar_images=[(0.0, 1.2), (10.0, 3.0)])
    wrong = changed(wrong, "halos", field_half_width_arcsec=3.0)
    with pytest.raises(ConfigError) as error:
        check_observation(wrong)
    outside, field = error.value.problems
    assert outside.startswith("smooth_model.quasar_images[1]: [10, 3] arcsec")
    assert "outside the image" in outside
    assert field.startswith("halos.field_half_width_arcsec = 3 is too small")


def test_a_missing_file_is_named(config: Config) -> None:
    assert config.observation.fits is not None
    block = config.observation.fits["F140W"].model_copy(update={"psf": "absent.fits"})
    with pytest.raises(ConfigError, match=r"absent\.fits: no such file"):
        check_observation(changed(config, "observation", fits={"F140W": block}))


def test_a_simulated_observation_has_its_field_checked(paper_config: Config) -> None:
    assert check_observation(paper_config) == []
    with pytest.raises(ConfigError, match="too small"):
        check_observation(changed(paper_config, "halos", field_half_width_arcsec=3.0))


def test_a_mirrored_image_is_said_to_be_one() -> None:
    mirrored = PixelGrid(10, 10, 0.1, 0.0, 0.0, ((-1.0, 0.0), (0.0, 1.0)))
    assert "north 0.0 degrees clockwise from up, east to its right (mirrored)" in describe_grid(mirrored)
