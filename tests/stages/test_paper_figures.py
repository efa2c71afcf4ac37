from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from warmlens.config import Config
from warmlens.config_file import parse_config
from warmlens.halos.whole_halo import MASS_BINS
from warmlens.stages import paper_figures


@pytest.fixture(scope="module")
def coarse(paper_config: Config) -> Config:
    raw = paper_config.model_dump()
    raw["halos"]["min_mass_msun"] = 1e8
    return parse_config(raw)


@pytest.mark.parametrize("name", ["1", "8"])
def test_figures_of_the_paper(coarse: Config, tmp_path: Path, name: str) -> None:
    paper_figures.run(name, coarse, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in tmp_path.iterdir()] == ["figure.png"]


def test_suppression_acts_on_each_bin() -> None:
    cold = np.zeros(MASS_BINS.size)
    cold[:31] = 2.0  # two subhaloes of 10^9 Msun
    assert MASS_BINS[30] == pytest.approx(9.0)
    halved = paper_figures._suppressed(cold, lambda mass, _: np.where(mass > 1e9, 0.5, 1.0), 0.0)
    np.testing.assert_allclose(halved, 0.5 * cold)
    none = paper_figures._suppressed(cold, lambda mass, _: np.ones_like(mass), 0.0)
    np.testing.assert_allclose(none, cold)
