from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from warmlens.artifacts import ArtifactError, Dataset, Provenance, open_artifact, settings_digest, write_artifact
from warmlens.campaign import draw_parameters
from warmlens.config import AbcBlock, DarkMatterBlock
from warmlens.stages import abc
from warmlens.stages.samples import FAILED_HERE, SampleTable
from warmlens.stages.settings import AbcSettings

N, CHUNK = 60, 20
DR, THRESHOLDS = np.linspace(0.0, 2.5, 6), np.linspace(-40.0, -4.0, 5)
PRIOR = DarkMatterBlock(m_th_kev=(1.0, 5.0), log10_m_halo_msun=(13.0, 13.5))


def _summary(m: np.ndarray) -> dict[str, Dataset]:
    """Summaries that are the relic mass itself, so that the nearest samples are known."""
    m = np.asarray(m, dtype=float)
    lead = ("sample",) * m.ndim
    return {
        "combined/correlation": Dataset(m[..., None] * np.ones(6), "", (*lead, "separation"), ""),
        "combined/cumulative": Dataset(m[..., None] * np.ones(5), "", (*lead, "threshold"), ""),
        "separation": Dataset(DR, "arcsec", ("separation",), ""),
        "thresholds": Dataset(THRESHOLDS, "", ("threshold",), ""),
    }


def _campaign(folder: Path, failed: tuple[int, ...] = ()) -> dict[str, object]:
    chunks = []
    for start in range(0, N, CHUNK):
        table = SampleTable(draw_parameters(1, (start, start + CHUNK), *PRIOR.model_dump().values()))
        m = table.parameters.m_th_kev.copy()
        for row in range(CHUNK):
            if start + row in failed:
                table.status[row], table.message[row], m[row] = FAILED_HERE, "mocks: broken", np.nan
        chunks.append(folder / f"chunk-{start}.h5")
        write_artifact(chunks[-1], Provenance("summaries", {}), {**table.datasets(), **_summary(m)}, {})
    write_artifact(folder / "observed.h5", Provenance("observed_summary", {}), _summary(np.array(4.0)), {})
    smooth = {"warnings": ["F814W: chi2_red = 3"]}
    write_artifact(folder / "smooth.h5", Provenance("smooth_model", {}), {}, smooth)
    return {
        "summaries": chunks,
        "observed_summary": folder / "observed.h5",
        "smooth_model": folder / "smooth.h5",
        "output": folder / "abc.h5",
        "table_csv": folder / "abc.csv",
    }


def _settings(**changes: object) -> AbcSettings:
    block = AbcBlock(acceptance="max_rank", fraction=0.2, bootstrap=100, max_failed_fraction=0.1)
    empty = settings_digest({})
    upstream = dict.fromkeys(("summaries", "observed_summary", "smooth_model"), empty)
    parts = {"seed": 1, "n_samples": N, "dark_matter": PRIOR, "abc": block, "upstream": upstream}
    return AbcSettings(**{**parts, **changes})


def test_the_nearest_samples_are_accepted(tmp_path: Path) -> None:
    campaign = _campaign(tmp_path, failed=(5, 33))
    abc.run(_settings(), **campaign)
    with open_artifact(tmp_path / "abc.h5", "abc") as artifact:
        m, accepted = artifact.array("table/m_th_kev"), artifact.array("table/accepted").astype(bool)
        distance, meta = artifact.array("table/distance_correlation"), artifact.metadata
    good = np.ones(N, dtype=bool)
    good[[5, 33]] = False
    expected = np.argsort(np.where(good, np.abs(m - 4.0), np.inf))[: round(0.2 * 58)]
    assert set(np.flatnonzero(accepted)) == set(expected)
    np.testing.assert_allclose(distance[good], 2.5 * (m[good] - 4.0) ** 2)
    assert np.isnan(distance[~good]).all()
    assert meta["bounds"]["q0455"]["value_kev"] == m[accepted].min()
    assert meta["n_failed"] == 2
    assert "F814W: chi2_red = 3" in meta["warnings"]
    assert "2 of 60 samples failed and are left out" in meta["warnings"]


def test_samples_beyond_the_campaign_are_left_out(tmp_path: Path) -> None:
    abc.run(_settings(n_samples=45), **_campaign(tmp_path))
    with open_artifact(tmp_path / "abc.h5", "abc") as artifact:
        assert artifact.array("table/sample_id").tolist() == list(range(45))


def test_too_many_failures(tmp_path: Path) -> None:
    with pytest.raises(
        ArtifactError, match=r"7 of 60 samples failed.*max_failed_fraction.*sample 0: mocks: broken"
    ):
        abc.run(_settings(), **_campaign(tmp_path, failed=tuple(range(7))))
    assert not (tmp_path / "abc.h5").exists()


def test_a_missing_chunk(tmp_path: Path) -> None:
    campaign = _campaign(tmp_path)
    campaign["summaries"] = campaign["summaries"][::2]
    with pytest.raises(ArtifactError, match=r"do not hold samples 0\.\.59 once each"):
        abc.run(_settings(), **campaign)


def test_other_settings_upstream(tmp_path: Path) -> None:
    stale = dict.fromkeys(("summaries", "observed_summary", "smooth_model"), settings_digest({"new": 1}))
    with pytest.raises(ArtifactError, match="made with other settings"):
        abc.run(_settings(upstream=stale), **_campaign(tmp_path))
