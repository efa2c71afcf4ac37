from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from warmlens.artifacts import ArtifactError, Dataset, Provenance, open_artifact, settings_digest, write_artifact
from warmlens.campaign import draw_parameters
from warmlens.combination import combine_results
from warmlens.config import AbcBlock, DarkMatterBlock
from warmlens.result import companions, others
from warmlens.stages import abc
from warmlens.stages.samples import FAILED_HERE, SampleTable
from warmlens.stages.settings import AbcSettings

N, CHUNK = 60, 20
DR, THRESHOLDS = np.linspace(0.0, 2.5, 6), np.linspace(-40.0, -4.0, 5)
SUMMARIES = {"scan": {"statistics": ["delta_r"]}}
PRIOR = DarkMatterBlock(m_th_kev=(1.0, 5.0), log10_m_halo_msun=(13.0, 13.5))


def _summary(m: np.ndarray, correlation: float = 1.0) -> dict[str, Dataset]:
    """Summaries that are the relic mass itself, so that the nearest samples are known."""
    m = np.asarray(m, dtype=float)
    lead = ("sample",) * m.ndim
    return {
        "combined/correlation": Dataset(correlation * m[..., None] * np.ones(6), "", (*lead, "separation"), ""),
        "combined/cumulative": Dataset(m[..., None] * np.ones(5), "", (*lead, "threshold"), ""),
        "combined/n_below": Dataset(np.round(10.0 * m), "", lead, ""),
        "combined/chi2": Dataset(100.0 + 0.0 * m, "", lead, ""),
        "separation": Dataset(DR, "arcsec", ("separation",), ""),
        "thresholds": Dataset(THRESHOLDS, "", ("threshold",), ""),
    }


def _campaign(
    folder: Path,
    failed: tuple[int, ...] = (),
    n: int = N,
    observed: float = 4.0,
    correlation: float = 1.0,
    noise: float = 0.0,
) -> dict[str, object]:
    chunks = []
    for start in range(0, n, CHUNK):
        table = SampleTable(draw_parameters(1, (start, start + CHUNK), *PRIOR.model_dump().values()))
        m = table.parameters.m_th_kev.copy()
        m += noise * np.random.default_rng(start).standard_normal(CHUNK)
        for row in range(CHUNK):
            if start + row in failed:
                table.status[row], table.message[row], m[row] = FAILED_HERE, "mocks: broken", np.nan
        chunks.append(folder / f"chunk-{start}.h5")
        write_artifact(
            chunks[-1], Provenance("summaries", SUMMARIES), {**table.datasets(), **_summary(m, correlation)}, {}
        )
    seen = _summary(np.array(observed), correlation)
    write_artifact(folder / "observed.h5", Provenance("observed_summary", SUMMARIES), seen, {})
    smooth = {"warnings": ["F814W: chi2_red = 3"]}
    write_artifact(folder / "smooth.h5", Provenance("smooth_model", {}), {}, smooth)
    return {
        "summaries": chunks,
        "observed_summary": folder / "observed.h5",
        "smooth_model": folder / "smooth.h5",
        "output": folder / "abc.h5",
        "table_csv": folder / "abc.csv",
        "numbers_json": folder / "abc.json",
    }


def _block(**changes: object) -> AbcBlock:
    keys = {"acceptance": "max_rank", "fraction": 0.2, "bootstrap": 100, "max_failed_fraction": 0.1}
    return AbcBlock(**{**keys, **changes})


def _settings(**changes: object) -> AbcSettings:
    block = _block()
    upstream = dict.fromkeys(("summaries", "observed_summary"), settings_digest(SUMMARIES))
    upstream["smooth_model"] = settings_digest({})
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
    table = pd.read_csv(tmp_path / "abc.csv")
    np.testing.assert_array_equal(table["accepted"], accepted)
    np.testing.assert_allclose(table["distance_correlation"], distance)
    np.testing.assert_allclose(table["cut_correlation"], distance)
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


def test_every_number_is_in_the_json_too(tmp_path: Path) -> None:
    abc.run(_settings(n_samples=800), **_campaign(tmp_path, n=800, noise=0.5, observed=3.2))
    found = json.loads((tmp_path / "abc.json").read_text())
    with open_artifact(tmp_path / "abc.h5", "abc") as artifact:
        assert {key: found[key] for key in artifact.metadata} == artifact.metadata
        assert found["artifact_digest"] == artifact.digest
        assert artifact.array("likelihood/replicates").shape == (100, 81)
        assert artifact.array("trials/ratio").shape == (800, 81)
        assert artifact.array("predictive/correlation/quantiles").shape == (5, 6)
        accepted = artifact.array("table/accepted").astype(bool)
        moved = artifact.array("table/adjusted_m_th_kev")
        np.testing.assert_array_equal(np.isfinite(moved), accepted)
        assert artifact.array("likelihood/ratio")[-1] == 1.0
    assert found["warnings"][-1] == "F814W: chi2_red = 3"
    assert found["n_accepted"] == 160
    assert set(found["bounds"]) == {"q05", "q0455", "q02275"}
    assert {*found["other_rules"]} == {"marginal_and", "scaled_sum", "correlation", "cumulative"}
    assert len(found["other_priors"]) == 7
    assert found["regression_adjustment"]["calibration"]["coverage"]["q0455"]["n"] == 800
    text = "\n".join(companions(found))
    for word in (
        "q05:",
        "falls to 1/10",
        "adjusted:",
        "coverage:",
        "expected:",
        "threshold:",
        "nat over the prior",
    ):
        assert word in text
    assert found["quotable"]
    assert set(found["summary_sets"]) == {"paper", "correlation", "cumulative", "learned", "learned_m"}
    assert [case["n_lenses"] for case in found["forecast"][:6]] == [1, 2, 4, 8, 16, 32]
    one = found["forecast"][0]["median_kev"]
    assert one == pytest.approx(found["expected_limit"]["quantiles_kev"][2], abs=0.25)
    rest = "\n".join(others(found))
    assert "rule scaled_sum: >" in rest
    assert "prior normal_13.9_0.3: >" in rest
    assert "91% of it lies outside" in rest


def test_whitened_distances_are_another_column(tmp_path: Path) -> None:
    settings = _settings(n_samples=200, abc=_block(distance="whitened"))
    abc.run(settings, **_campaign(tmp_path, n=200, noise=0.3))
    table = pd.read_csv(tmp_path / "abc.csv")
    m = table["distance_correlation"] / table["cut_correlation"]
    assert m.std() > 0.0 or not np.allclose(m, 1.0)
    assert np.corrcoef(table["distance_correlation"], table["cut_correlation"])[0, 1] > 0.99


def _warnings(tmp_path: Path) -> str:
    return "\n".join(json.loads((tmp_path / "abc.json").read_text())["warnings"])


def test_a_small_table_is_not_a_normal_bound(tmp_path: Path) -> None:
    abc.run(_settings(), **_campaign(tmp_path))
    text = _warnings(tmp_path)
    assert "the table has 60 samples only" in text
    assert "only 12 samples are accepted" in text
    assert "calibrated on 60 rows only" in text
    found = json.loads((tmp_path / "abc.json").read_text())
    assert not found["regression_adjustment"]["valid"]
    assert "needs 100 accepted samples, there are 12" in found["regression_adjustment"]["reason"]
    assert found["threshold_convergence"]["raw"] == "too few samples to tell"
    assert not found["quotable"]


def test_an_observation_outside_the_cloud_is_not_a_normal_bound(tmp_path: Path) -> None:
    abc.run(_settings(n_samples=300), **_campaign(tmp_path, n=300, observed=11.0))
    assert "THE OBSERVATION LIES OUTSIDE THE SIMULATIONS in correlation" in _warnings(tmp_path)
    assert not json.loads((tmp_path / "abc.json").read_text())["quotable"]


def test_a_correlation_function_that_is_zero_everywhere_is_not_a_normal_bound(tmp_path: Path) -> None:
    abc.run(_settings(n_samples=300), **_campaign(tmp_path, n=300, correlation=0.0, noise=0.5))
    text = _warnings(tmp_path)
    assert "all samples have the same distance in correlation" in text
    found = json.loads((tmp_path / "abc.json").read_text())
    assert "use max_rank" in found["other_rules"]["scaled_sum"]["warnings"][0]
    assert found["n_ties"] > 0


def test_ties_in_everything_say_that_there_is_no_information(tmp_path: Path) -> None:
    campaign = _campaign(tmp_path, n=300)
    for path in [*campaign["summaries"], campaign["observed_summary"]]:
        with open_artifact(path, "summaries" if "chunk" in path.name else "observed_summary") as artifact:
            span, stage = artifact.span, artifact.stage
            arrays = {name: artifact[f"samples/{name}"][...] for name in artifact.file.get("samples", {})}
        if stage == "observed_summary":
            write_artifact(path, Provenance(stage, SUMMARIES), _summary(np.array(0.0)), {})
            continue
        table = SampleTable(
            draw_parameters(1, (arrays["sample_id"][0], arrays["sample_id"][-1] + 1), *PRIOR.model_dump().values())
        )
        write_artifact(
            path, Provenance(stage, SUMMARIES, span=span), {**table.datasets(), **_summary(np.zeros(CHUNK))}, {}
        )
    abc.run(_settings(n_samples=300), **campaign)
    text = _warnings(tmp_path)
    assert "300 samples tie at the acceptance threshold" in text
    assert "all samples have the same distance in cumulative" in text
    assert "indistinguishable from the prior" in text


def test_too_few_marginal_cuts_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match=r"marginal_and leaves \d+ of 60 samples.*raise abc\.fraction"):
        abc.run(_settings(abc=_block(acceptance="marginal_and")), **_campaign(tmp_path))
    assert not (tmp_path / "abc.json").exists()


def test_lenses_are_combined_by_their_likelihood_ratios(tmp_path: Path) -> None:
    folders = []
    for name, observed in (("one", 4.5), ("two", 4.7)):
        folder = tmp_path / name
        folder.mkdir()
        abc.run(_settings(n_samples=400), **_campaign(folder, n=400, noise=0.8, observed=observed))
        folders.append(folder)
    found = combine_results(folders, tmp_path / "both.json")
    assert json.loads((tmp_path / "both.json").read_text()) == found
    single = [json.loads((folder / "abc.json").read_text())["bounds"]["q0455"]["value_kev"] for folder in folders]
    assert found["bounds"]["q0455"]["value_kev"] > max(single) - 0.1
    assert any(text.startswith(f"{folders[1]}: F814W: chi2_red = 3") for text in found["warnings"])
    with pytest.raises(ArtifactError, match="are of the same observation, which would count twice"):
        combine_results([folders[0], folders[0]], None)
    with pytest.raises(ArtifactError, match="at least two campaigns"):
        combine_results(folders[:1], None)
