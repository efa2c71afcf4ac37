from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Dataset, open_artifact
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.config.digest import settings_digest
from warmlens.config.model import AbcBlock, DarkMatterBlock
from warmlens.products.samples import FAILED_HERE, SampleTable
from warmlens.report.exclusion import exclusion_lines
from warmlens.sampling import grid_parameters
from warmlens.stage_table import ExclusionSettings, GridNodes

from ..shared import run_stage

NODES = GridNodes(design="grid", m_th_kev=[1.0, 5.0], log10_m_halo_msun=[12.0, 12.5, 13.0, 13.5])
REALIZATIONS, CHUNK = 25, 40
N = 8 * REALIZATIONS
SUMMARIES = {"scan": {"statistics": ["delta_r"]}}


def _summary(signal: np.ndarray) -> dict[str, Dataset]:
    """Summaries that are one number, so that the nearest samples are known."""
    signal = np.asarray(signal, dtype=float)
    lead = ("sample",) * signal.ndim
    return {
        "combined/correlation": Dataset(signal[..., None] * np.ones(6), "", (*lead, "separation"), ""),
        "combined/cumulative": Dataset(signal[..., None] * np.ones(5), "", (*lead, "threshold"), ""),
        "combined/counts": Dataset(signal[..., None] * np.ones(3), "", (*lead, "count threshold"), ""),
        "combined/chi2": Dataset(100.0 + 0.0 * signal, "", lead, ""),
        "separation": Dataset(np.linspace(0.0, 2.5, 6), "arcsec", ("separation",), ""),
        "thresholds": Dataset(np.linspace(-40.0, -4.0, 5), "", ("threshold",), ""),
        "count_thresholds": Dataset(np.array([-25.0, -10.0, -4.0]), "", ("count threshold",), ""),
    }


def _campaign(folder: Path, failed: tuple[int, ...] = ()) -> dict[str, Any]:
    """Samples whose summary is log10 of their halo mass and a little noise; the observation has 13.5."""
    chunks = []
    for start in range(0, N, CHUNK):
        table = SampleTable(grid_parameters((start, start + CHUNK), NODES.m_th_kev, NODES.log10_m_halo_msun))
        signal = table.parameters.log10_m_halo_msun + 0.05 * np.random.default_rng(start).standard_normal(CHUNK)
        for row in range(CHUNK):
            if start + row in failed:
                table.status[row], table.message[row], signal[row] = FAILED_HERE, "mocks: broken", np.nan
        chunks.append(folder / f"chunk-{start}.h5")
        write_artifact(
            chunks[-1], Provenance("summaries", SUMMARIES), {**table.datasets(), **_summary(signal)}, {}
        )
    write_artifact(folder / "observed.h5", Provenance("observed_summary", SUMMARIES), _summary(np.array(13.5)), {})
    judgement = {"problems": [], "notes": ["note of the fit"]}
    write_artifact(folder / "smooth.h5", Provenance("smooth_model", {}), {}, judgement)
    return {
        "summaries": chunks,
        "observed_summary": folder / "observed.h5",
        "smooth_model": folder / "smooth.h5",
        "output": folder / "exclusion.h5",
    }


def _settings(**changes: object) -> ExclusionSettings:
    block = {"acceptance": "max_rank", "fraction": 0.5, "bootstrap": 100, "max_failed_fraction": 0.1, **changes}
    upstream = dict.fromkeys(("summaries", "observed_summary"), settings_digest(SUMMARIES))
    return ExclusionSettings(
        seed=1,
        n_samples=N,
        dark_matter=DarkMatterBlock(m_th_kev=(1.0, 5.0), log10_m_halo_msun=(12.0, 13.5)),
        nodes=NODES,
        abc=AbcBlock(**block),
        upstream={**upstream, "smooth_model": settings_digest({})},
    )


def test_light_halos_are_excluded(tmp_path: Path) -> None:
    run_stage("exclusion", _settings(), **_campaign(tmp_path, failed=(3,)))
    with open_artifact(tmp_path / "exclusion.h5", "exclusion") as artifact:
        meta, accepted = artifact.metadata, artifact.array("nodes/n_accepted")
        mass = artifact.array("table/log10_m_halo_msun")[artifact.array("table/accepted").astype(bool)]
        distance = artifact.array("table/distance_correlation")
        excluded = artifact.array("halo_mass/excluded")
    assert meta["n_accepted"] == round(0.5 * (N - 1)) == accepted.sum() == mass.size
    assert accepted[:2].sum() == 0  # the nearest half has 13 and 13.5
    assert [int((mass == node).sum()) for node in NODES.log10_m_halo_msun] == accepted.sum(axis=1).tolist()
    assert excluded.tolist() == [1, 1, 0, 0]
    assert meta["excluded_up_to_log10_m_halo_msun"] == 12.5
    assert meta["statement"].startswith("halo masses up to 10^12.5 Msun are excluded at 96.")
    assert np.isnan(distance[3])
    assert {"1 of 200 samples failed and are left out", "note of the fit"} <= set(meta["warnings"])
    lines = "\n".join(exclusion_lines(meta))
    assert "10^12 Msun: 0 of 50 accepted, posterior 0.0% [0.0%, 3.6%], the prior alone 25.0%" in lines
    nodes = pd.read_csv(tmp_path / "exclusion.csv")
    assert nodes["n_accepted"].tolist() == accepted.ravel().tolist()
    assert nodes["probability"].sum() == pytest.approx(1.0)
    first = nodes[(nodes["m_th_kev"] == 1.0) & (nodes["log10_m_halo_msun"] == 13.5)].iloc[0]
    assert first["n_accepted"] == accepted[3, 0]
    whole = json.loads((tmp_path / "exclusion.json").read_text())
    assert whole["halo_masses"] == meta["halo_masses"]
    assert len(whole["nodes"]) == 8


def test_too_few_accepted_exclude_nothing(tmp_path: Path) -> None:
    run_stage("exclusion", _settings(fraction=0.1), **_campaign(tmp_path))
    with open_artifact(tmp_path / "exclusion.h5", "exclusion") as artifact:
        meta = artifact.metadata
    assert meta["statement"] == "no halo mass is excluded at 95.45%"
    assert any("20 accepted samples cannot exclude" in warning for warning in meta["warnings"])
    assert "EXCLUDED" not in "\n".join(exclusion_lines(meta))


def test_other_summaries_and_rules(tmp_path: Path) -> None:
    campaign = _campaign(tmp_path)
    cases = (
        ({"summaries": "learned"}, 12.0),  # it cuts on the relic mass too, of which these know nothing
        ({"distance": "whitened"}, 12.5),
        ({"acceptance": "scaled_sum"}, 12.5),
    )
    for block, expected in cases:
        run_stage("exclusion", _settings(**block), **campaign)
        with open_artifact(tmp_path / "exclusion.h5", "exclusion") as artifact:
            assert artifact.metadata["excluded_up_to_log10_m_halo_msun"] == expected, block


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match=r"30 of 200 samples failed.*sample 0: mocks: broken"):
        run_stage("exclusion", _settings(), **_campaign(tmp_path, failed=tuple(range(30))))
    campaign = _campaign(tmp_path)
    with pytest.raises(ArtifactError, match="at least 2 are needed"):
        run_stage("exclusion", _settings(fraction=0.001), **campaign)
    other = _settings().model_copy(update={"upstream": {"summaries": settings_digest({"old": 1})}})
    with pytest.raises(ArtifactError, match=r"chunk-0\.h5: made with other settings"):
        run_stage("exclusion", other, **campaign)
    assert not (tmp_path / "exclusion.h5").exists()
