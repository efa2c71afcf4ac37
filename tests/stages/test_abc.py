from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from warmlens.artifacts import writing
from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Dataset, open_artifact
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.config.digest import settings_digest
from warmlens.config.model import AbcBlock, DarkMatterBlock
from warmlens.imaging.grid import PixelGrid
from warmlens.imaging.noise import NoiseModel
from warmlens.imaging.observation import Observation, checked_band
from warmlens.products.observation import observation_datasets
from warmlens.products.samples import FAILED_HERE, SampleTable
from warmlens.report import combination
from warmlens.report.combination import combine_results
from warmlens.report.result import companions, others
from warmlens.sampling import draw_parameters
from warmlens.stage_table import AbcSettings

from ..reliability import NOTHING, Outcome, fault
from ..shared import run_stage

N, CHUNK = 60, 20
DR, THRESHOLDS = np.linspace(0.0, 2.5, 6), np.linspace(-40.0, -4.0, 5)
SUMMARIES = {"scan": {"statistics": ["delta_r"]}}
PRIOR = DarkMatterBlock(m_th_kev=(1.0, 5.0), log10_m_halo_msun=(13.0, 13.5))


def _paper(m: np.ndarray, correlation: float = 1.0) -> dict[str, Dataset]:
    """Summaries that are the relic mass itself, so that the nearest samples are known."""
    m = np.asarray(m, dtype=float)
    lead = ("sample",) * m.ndim
    return {
        "combined/correlation": Dataset(correlation * m[..., None] * np.ones(6), "", (*lead, "separation"), ""),
        "combined/cumulative": Dataset(m[..., None] * np.ones(5), "", (*lead, "threshold"), ""),
        "combined/counts": Dataset(np.round(m[..., None] * [1.0, 10.0]), "", (*lead, "count threshold"), ""),
        "combined/chi2": Dataset(100.0 + 0.0 * m, "", lead, ""),
        "separation": Dataset(DR, "arcsec", ("separation",), ""),
        "thresholds": Dataset(THRESHOLDS, "", ("threshold",), ""),
        "count_thresholds": Dataset(np.array([-10.0, -4.0]), "", ("count threshold",), ""),
    }


def _response(m: np.ndarray) -> dict[str, Dataset]:
    """A linear response that tells of the relic mass too."""
    m = np.asarray(m, dtype=float)
    lead = ("sample",) * m.ndim
    wave = m[..., None] * np.arange(1.0, 7.0) + np.sin(50.0 * m)[..., None]
    return {
        "combined/mean_z2": Dataset(1.0 + m, "", lead, ""),
        "combined/amplitude_correlation": Dataset(wave, "", (*lead, "separation"), ""),
    }


def _campaign(
    folder: Path,
    failed: tuple[int, ...] = (),
    n: int = N,
    observed: float = 4.0,
    correlation: float = 1.0,
    noise: float = 0.0,
    null: tuple[float, ...] = (),
    response: bool = False,
    constant: dict[str, float] | None = None,
) -> dict[str, object]:
    settings = {"scan": {"statistics": ["delta_r", "amplitude"]}} if response else SUMMARIES

    def _summary(m: np.ndarray, correlation: float = 1.0) -> dict[str, Dataset]:
        return _paper(m, correlation) | (_response(m) if response else {})

    chunks = []
    for start in range(0, n, CHUNK):
        table = SampleTable(draw_parameters(1, (start, start + CHUNK), *PRIOR.model_dump().values()))
        same = {name: np.full(CHUNK, value) for name, value in (constant or {}).items()}
        table.parameters = dataclasses.replace(table.parameters, **same)
        m = table.parameters.m_th_kev.copy()
        m += noise * np.random.default_rng(start).standard_normal(CHUNK)
        for row in range(CHUNK):
            if start + row in failed:
                table.status[row], table.message[row], m[row] = FAILED_HERE, "mocks: broken", np.nan
        chunks.append(folder / f"chunk-{start}.h5")
        write_artifact(
            chunks[-1], Provenance("summaries", settings), {**table.datasets(), **_summary(m, correlation)}, {}
        )
    seen = _summary(np.array(observed), correlation)
    write_artifact(folder / "observed.h5", Provenance("observed_summary", settings), seen, {})
    if null:
        table = SampleTable.without_substructure(len(null))
        table.status[np.isnan(null)] = FAILED_HERE
        mocks = {**table.datasets(), **_summary(np.array(null), correlation)}
        write_artifact(folder / "null.h5", Provenance("null_summaries", settings), mocks, {})
    smooth = {"problems": [], "notes": ["F814W: chi2_red = 0.7"]}
    write_artifact(folder / "smooth.h5", Provenance("smooth_model", {}), {}, smooth)
    return {
        "summaries": chunks,
        "observed_summary": folder / "observed.h5",
        "smooth_model": folder / "smooth.h5",
        "output": folder / "abc.h5",
        "null_summaries": folder / "null.h5" if null else None,
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
    run_stage("abc", _settings(), **campaign)
    with open_artifact(tmp_path / "abc.h5", "abc") as artifact:
        m, accepted = artifact.array("table/m_th_kev"), artifact.array("table/accepted").astype(bool)
        distance, meta = artifact.array("table/distance_correlation"), artifact.metadata
        columns = {name.removeprefix("table/") for name in artifact.names if name.startswith("table/")}
    good = np.ones(N, dtype=bool)
    good[[5, 33]] = False
    expected = np.argsort(np.where(good, np.abs(m - 4.0), np.inf))[: round(0.2 * 58)]
    assert set(np.flatnonzero(accepted)) == set(expected)
    np.testing.assert_allclose(distance[good], 2.5 * (m[good] - 4.0) ** 2)
    assert np.isnan(distance[~good]).all()
    assert meta["bounds"]["q0455"]["value_kev"] == m[accepted].min()
    assert meta["n_failed"] == 2
    table = pd.read_csv(tmp_path / "abc.csv")
    assert set(table.columns) == columns, "a column of abc.csv needs a row of _COLUMNS"
    np.testing.assert_array_equal(table["accepted"], accepted)
    np.testing.assert_allclose(table["distance_correlation"], distance)
    np.testing.assert_allclose(table["cut_correlation"], distance)
    assert "F814W: chi2_red = 0.7" in meta["warnings"]
    assert "2 of 60 samples failed and are left out" in meta["warnings"]


def test_samples_beyond_the_campaign_are_left_out(tmp_path: Path) -> None:
    run_stage("abc", _settings(n_samples=45), **_campaign(tmp_path))
    with open_artifact(tmp_path / "abc.h5", "abc") as artifact:
        assert artifact.array("table/sample_id").tolist() == list(range(45))


def test_too_many_failures(tmp_path: Path) -> None:
    with pytest.raises(
        ArtifactError, match=r"7 of 60 samples failed.*max_failed_fraction.*sample 0: mocks: broken"
    ):
        run_stage("abc", _settings(), **_campaign(tmp_path, failed=tuple(range(7))))
    assert not (tmp_path / "abc.h5").exists()


def test_a_missing_chunk(tmp_path: Path) -> None:
    campaign = _campaign(tmp_path)
    campaign["summaries"] = campaign["summaries"][::2]
    with pytest.raises(ArtifactError, match=r"do not hold samples 0\.\.59 once each"):
        run_stage("abc", _settings(), **campaign)


def test_other_settings_upstream(tmp_path: Path) -> None:
    stale = dict.fromkeys(("summaries", "observed_summary", "smooth_model"), settings_digest({"new": 1}))
    with pytest.raises(ArtifactError, match="made with other settings"):
        run_stage("abc", _settings(upstream=stale), **_campaign(tmp_path))


def test_every_number_is_in_the_json_too(tmp_path: Path) -> None:
    run_stage("abc", _settings(n_samples=800), **_campaign(tmp_path, n=800, noise=0.5, observed=3.2))
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
    assert "F814W: chi2_red = 0.7" in found["warnings"]
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
    assert (found["verdict"], found["quotable"]) == ("measured", True)
    assert list(found["summary_sets"]) == ["paper", "correlation", "cumulative", "sharper", "learned", "learned_m"]
    assert found["summary_sets"]["sharper"]["kinds"] == ["counts"]  # there is no linear response
    assert found["null_test"] is None
    assert found["observation_among_samples"]["positions_below_-4"]["observed"] == 32.0
    assert [case["n_lenses"] for case in found["forecast"][:6]] == [1, 2, 4, 8, 16, 32]
    one = found["forecast"][0]["median_kev"]
    assert one == pytest.approx(found["expected_limit"]["quantiles_kev"][2], abs=0.25)
    rest = "\n".join(others(found))
    assert "rule scaled_sum: >" in rest
    assert "prior normal_13.9_0.3: >" in rest
    assert "91% of it lies outside" in rest


def test_whitened_distances_are_another_column(tmp_path: Path) -> None:
    settings = _settings(n_samples=200, abc=_block(distance="whitened"))
    run_stage("abc", settings, **_campaign(tmp_path, n=200, noise=0.3))
    table = pd.read_csv(tmp_path / "abc.csv")
    m = table["distance_correlation"] / table["cut_correlation"]
    assert m.std() > 0.0 or not np.allclose(m, 1.0)
    assert np.corrcoef(table["distance_correlation"], table["cut_correlation"])[0, 1] > 0.99


def _warnings(tmp_path: Path) -> str:
    found = json.loads((tmp_path / "abc.json").read_text())
    return "\n".join(found["reasons"] + found["warnings"])


def test_a_small_table_is_not_a_normal_bound(tmp_path: Path) -> None:
    run_stage("abc", _settings(), **_campaign(tmp_path))
    text = _warnings(tmp_path)
    assert "the table has 60 samples only" in text
    assert "only 12 samples are accepted" in text
    assert "calibrated on 60 rows only" in text
    found = json.loads((tmp_path / "abc.json").read_text())
    assert not found["regression_adjustment"]["valid"]
    assert "needs 100 accepted samples, there are 12" in found["regression_adjustment"]["reason"]
    assert found["threshold_convergence"]["raw"] == "too few samples to tell"
    assert (found["verdict"], found["quotable"]) == ("not usable", False)


def test_an_observation_outside_the_cloud_is_not_a_normal_bound(tmp_path: Path) -> None:
    run_stage("abc", _settings(n_samples=300), **_campaign(tmp_path, n=300, observed=11.0))
    assert "THE OBSERVATION LIES OUTSIDE THE SIMULATIONS in correlation" in _warnings(tmp_path)
    assert json.loads((tmp_path / "abc.json").read_text())["verdict"] == "not usable"


def test_a_correlation_function_that_is_zero_everywhere_is_not_a_normal_bound(tmp_path: Path) -> None:
    run_stage("abc", _settings(n_samples=300), **_campaign(tmp_path, n=300, correlation=0.0, noise=0.5))
    text = _warnings(tmp_path)
    assert "all samples have the same distance in correlation" in text
    found = json.loads((tmp_path / "abc.json").read_text())
    assert "use max_rank" in found["other_rules"]["scaled_sum"]["warnings"][0]
    assert found["n_ties"] > 0


def test_a_parameter_that_never_changes_is_not_a_normal_bound(tmp_path: Path) -> None:
    settings = _settings(n_samples=200, abc=_block(leave_one_out=50))
    run_stage("abc", settings, **_campaign(tmp_path, n=200, noise=0.3, constant={"log10_m_halo_msun": 13.25}))
    assert "all samples have the halo mass 10^13.25 Msun: nothing is marginalised" in _warnings(tmp_path)
    with pytest.raises(ArtifactError, match=r"cannot be used: all 200 samples have m_kev = 3\.0: no bound"):
        run_stage("abc", settings, **_campaign(tmp_path, n=200, noise=0.3, constant={"m_th_kev": 3.0}))


def test_ties_in_everything_say_that_there_is_no_information(tmp_path: Path) -> None:
    campaign = _campaign(tmp_path, n=300)
    for path in [*campaign["summaries"], campaign["observed_summary"]]:
        with open_artifact(path, "summaries" if "chunk" in path.name else "observed_summary") as artifact:
            span, stage = artifact.span, artifact.stage
            arrays = {name: artifact[f"samples/{name}"][...] for name in artifact.file.get("samples", {})}
        if stage == "observed_summary":
            write_artifact(path, Provenance(stage, SUMMARIES), _paper(np.array(0.0)), {})
            continue
        table = SampleTable(
            draw_parameters(1, (arrays["sample_id"][0], arrays["sample_id"][-1] + 1), *PRIOR.model_dump().values())
        )
        write_artifact(
            path, Provenance(stage, SUMMARIES, span=span), {**table.datasets(), **_paper(np.zeros(CHUNK))}, {}
        )
    run_stage("abc", _settings(n_samples=300), **campaign)
    text = _warnings(tmp_path)
    assert "300 samples tie at the acceptance threshold" in text
    assert "all samples have the same distance in cumulative" in text
    assert "indistinguishable from the prior" in text


def test_the_null_test_stands_beside_the_bound(tmp_path: Path) -> None:
    """Mocks whose summaries are those of warm samples; one has failed."""
    null = (*np.linspace(1.0, 1.6, 45), np.nan)
    settings = _settings(n_samples=600, abc=_block(leave_one_out=150))
    run_stage("abc", settings, **_campaign(tmp_path, n=600, noise=0.3, observed=4.5, null=null))
    found = json.loads((tmp_path / "abc.json").read_text())
    test = found["null_test"]
    assert (test["n_mocks"], test["n_failed"]) == (45, 1)
    assert 1.0 <= test["bound_kev"]["low"] <= test["bound_kev"]["median"] <= test["bound_kev"]["high"] < 1.5
    assert test["fraction_reaching_bound"] == 0.0
    assert test["prior_only_kev"] == pytest.approx(1.182, abs=0.1)
    assert test["prior_only_kev"] == found["bounds"]["q0455"]["prior_only_kev"]
    assert test["expected_limit_kev"] == found["expected_limit"]["quantiles_kev"][2]
    place = test["observation_among_mocks"]["correlation_at_0"]
    assert (place["observed"], place["rank"], place["n"]) == (4.5, 1.0, 45)
    assert place["p_value"] == pytest.approx(2 / 46)
    assert test["distance_p"]["correlation"] == pytest.approx(1 / 46)
    assert "null test: 1 of 46 mocks without substructure failed and are left out" in found["warnings"]
    assert "give a bound as high" not in _warnings(tmp_path)
    with open_artifact(tmp_path / "abc.h5", "abc") as artifact:
        assert "null_summaries" in artifact.inputs
        assert artifact.array("null/sample").tolist() == list(range(45))
        assert artifact.array("null/bounds").shape == (45, 3)
        np.testing.assert_array_equal(artifact.array("null/correlation_at_0"), null[:45])
        assert artifact.array("null/cumulative/quantiles").shape == (5, 5)
    text = "\n".join(companions(found))
    alone = f"the prior alone {test['prior_only_kev']:.2f} keV"
    assert f"from 45 mocks without substructure; {alone}, cold dark matter" in text
    assert "100% in correlation_at_0 (p = 0.043)" in text


def test_mocks_without_substructure_that_reach_the_bound_are_cried_out(tmp_path: Path) -> None:
    null = (*np.full(9, 1.5), 4.8)
    settings = _settings(n_samples=300, abc=_block(leave_one_out=60))
    run_stage("abc", settings, **_campaign(tmp_path, n=300, noise=0.5, observed=4.5, null=null))
    assert "null test: 10% of 10 mocks without substructure give a bound as high" in _warnings(tmp_path)


def test_a_null_test_of_other_settings_is_refused(tmp_path: Path) -> None:
    settings = _settings()
    stale = {**settings.upstream, "null_summaries": settings_digest({"new": 1})}
    with pytest.raises(ArtifactError, match=r"null\.h5: made with other settings"):
        run_stage("abc", _settings(upstream=stale), **_campaign(tmp_path, null=(1.0, 2.0)))


def test_a_null_test_of_which_nothing_is_left_is_said(tmp_path: Path) -> None:
    run_stage("abc", _settings(), **_campaign(tmp_path, null=(np.nan, np.nan)))
    assert "null test: 2 of 2 mocks without substructure failed" in _warnings(tmp_path)
    assert json.loads((tmp_path / "abc.json").read_text())["null_test"] is None


def test_an_observation_at_the_edge_of_the_samples_is_said(tmp_path: Path) -> None:
    """Inside the cloud as far as distances go, and yet higher than all but a few samples."""
    settings = _settings(n_samples=400, abc=_block(leave_one_out=60))
    run_stage("abc", settings, **_campaign(tmp_path, n=400, observed=4.98))
    found = json.loads((tmp_path / "abc.json").read_text())
    assert found["observation_among_samples"]["correlation_at_0"]["p_value"] < 0.05
    assert "the observation is at the edge of the samples in correlation_at_0: 99." in _warnings(tmp_path)
    run_stage("abc", settings, **_campaign(tmp_path, n=400, observed=4.5))
    assert "edge of the samples" not in _warnings(tmp_path)


@pytest.mark.parametrize("name", ["sharper", "learned"])
def test_other_summaries_as_the_headline(tmp_path: Path, name: str) -> None:
    campaign = _campaign(tmp_path, n=600, noise=0.3, observed=4.0, null=(1.2, 1.3, 1.4), response=True)
    upstream = dict.fromkeys(("observed_summary", "summaries"), settings_digest(_both()))
    run_stage(
        "abc",
        _settings(n_samples=600, abc=_block(summaries=name, leave_one_out=100), upstream=upstream),
        **campaign,
    )
    found = json.loads((tmp_path / "abc.json").read_text())
    kinds = {"sharper": ["response", "counts"], "learned": ["learned_m", "learned_mass"]}[name]
    assert (found["summaries"], found["kinds"]) == (name, kinds)
    assert set(found["nearest_neighbour_percentile"]) == set(kinds)
    assert list(found["other_rules"]) == ["marginal_and", "scaled_sum", *kinds]
    sets = found["summary_sets"]
    assert sets[name]["bound"]["value_kev"] == found["bounds"]["q0455"]["value_kev"]  # one and the same procedure
    assert sets["paper"]["kinds"] == ["correlation", "cumulative"]  # the paper's stands beside it
    assert sets["paper"]["bound"]["value_kev"] > 1.2
    assert found["learned"]["r_squared"][0] > 0.8
    assert len(found["posterior_predictive_p"]) == 2
    table = pd.read_csv(tmp_path / "abc.csv")
    assert {f"cut_{kind}" for kind in kinds} < set(table.columns)
    assert "cut_correlation" not in table
    assert found["null_test"]["bound_kev"]["high"] < found["bounds"]["q0455"]["value_kev"]


def test_headline_summaries_that_are_missing_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ArtifactError, match=r"abc\.summaries: sharper cannot be used: the linear response needs scan"
    ):
        run_stage("abc", _settings(abc=_block(summaries="sharper")), **_campaign(tmp_path))
    few = _campaign(tmp_path, n=40)
    with pytest.raises(
        ArtifactError, match=r"learned cannot be used: learned summaries need 50 samples, there are 40"
    ):
        run_stage("abc", _settings(n_samples=40, abc=_block(summaries="learned")), **few)
    run_stage("abc", _settings(n_samples=40), **few)
    found = json.loads((tmp_path / "abc.json").read_text())
    assert "need 50 samples" in found["summary_sets"]["learned"]["refused"]
    assert found["summary_sets"]["paper"]["bound"]["k"] == 8
    assert "summaries learned: none: learned summaries need" in "\n".join(companions(found))
    with pytest.raises(ValueError, match="use max_rank, marginal_and or scaled_sum"):
        _block(summaries="learned", acceptance="cumulative")


def _both() -> dict[str, object]:
    return {"scan": {"statistics": ["delta_r", "amplitude"]}}


def test_too_few_marginal_cuts_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match=r"marginal_and leaves \d+ of 60 samples.*raise abc\.fraction"):
        run_stage("abc", _settings(abc=_block(acceptance="marginal_and")), **_campaign(tmp_path))
    assert not (tmp_path / "abc.json").exists()


def _observe(folder: Path, bands: dict[str, np.ndarray], mask: np.ndarray, settings: dict[str, object]) -> None:
    """Write an observation of some images [ny, nx]."""
    grid = PixelGrid.centred(mask.shape, 0.05)
    psf = np.zeros((3, 3))
    psf[1, 1] = 1.0
    made = tuple(
        checked_band(name, grid, image, np.ones(grid.shape), mask, psf, NoiseModel(1.0, 100.0))
        for name, image in bands.items()
    )
    provenance = Provenance("observation", {"observation": {"kind": "fits", **settings}})
    write_artifact(folder / "observation.h5", provenance, *observation_datasets(Observation("fits", grid, made)))


@pytest.fixture(scope="module")
def lenses(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Finished inferences on two lenses."""
    folders = [tmp_path_factory.mktemp(name) for name in ("one", "two")]
    for folder, observed in zip(folders, (4.5, 4.7), strict=True):
        settings = _settings(n_samples=400, abc=_block(leave_one_out=300))
        run_stage("abc", settings, **_campaign(folder, n=400, noise=0.8, observed=observed))
    return folders


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers without a campaign: tests/workflow/test_answers.py is about their chain."""
    monkeypatch.setattr(combination, "open_answer", lambda folder: open_artifact(folder / "abc.h5", "abc"))


IMAGES = np.random.default_rng(8).normal(1.0, 0.3, (3, 20, 20))
EVERYWHERE = np.ones((20, 20), dtype=bool)


@pytest.mark.usefixtures("unchecked")
def test_lenses_are_combined_by_their_likelihood_ratios(
    unchecked: None, lenses: list[Path], tmp_path: Path
) -> None:
    for folder, image in zip(lenses, IMAGES, strict=False):
        _observe(folder, {"F814W": image}, EVERYWHERE, {})
    found = combine_results(lenses, tmp_path / "both.json")
    assert json.loads((tmp_path / "both.json").read_text()) == found
    single = [json.loads((folder / "abc.json").read_text()) for folder in lenses]
    assert found["lenses"] == {str(folder): one["verdict"] for folder, one in zip(lenses, single, strict=True)}
    assert found["verdict"] == "measured"
    assert found["bounds"]["q0455"]["value_kev"] > max(one["bounds"]["q0455"]["value_kev"] for one in single) - 0.1
    assert any(text.startswith(f"{lenses[1]}: F814W: chi2_red = 0.7") for text in found["warnings"])
    with pytest.raises(ArtifactError, match="at least two campaigns"):
        combine_results(lenses[:1], None)


@pytest.mark.usefixtures("unchecked")
@fault("Answers", "one image is combined with itself", "other summaries, mask, cutout, bands or noise", quick=True)
@pytest.mark.parametrize("other", ["summaries", "mask", "cutout", "band", "truth", "counts"])
def test_one_observation_counts_once(lenses: list[Path], outcome: Outcome, other: str) -> None:
    first, second = {"F814W": IMAGES[0], "F555W": IMAGES[1]}, {"F814W": IMAGES[0], "F555W": IMAGES[1]}
    mask, settings = EVERYWHERE, [{}, {}]
    if other == "mask":
        mask = np.add.outer(np.arange(20), np.arange(20)) > 12
    elif other == "cutout":
        second, mask = {"I": IMAGES[0][3:-3, 2:-4]}, np.ones((14, 14), dtype=bool)
    elif other == "band":
        second = {"F555W": IMAGES[1], "F160W": IMAGES[2]}
    elif other == "truth":  # another exposure of the same simulated lens
        second = {"F160W": IMAGES[2]}
        settings = [{"simulated": {"truth": 1, "bands": name}} for name in first]
    elif other == "counts":
        first = second = {"F814W": np.round(IMAGES[0])}
    _observe(lenses[0], first, EVERYWHERE, settings[0])
    _observe(lenses[1], second, mask, settings[1])
    with pytest.raises(ArtifactError) as refused:
        combine_results(lenses, None)
    outcome.stops(str(refused.value), "are of the same observation", str(lenses[0]), str(lenses[1]))


@pytest.mark.usefixtures("unchecked")
def test_images_of_whole_counts_of_two_lenses_are_two_lenses(lenses: list[Path]) -> None:
    for folder, image in zip(lenses, IMAGES, strict=False):
        _observe(folder, {"F814W": np.round(5.0 * image)}, EVERYWHERE, {})
    assert combine_results(lenses, None)["lenses"].keys() == {str(folder) for folder in lenses}


@fault("Origin", "samples are made by two versions of the code", "a summary edited before `extend`", quick=True)
def test_a_mixed_table_is_not_usable(tmp_path: Path, outcome: Outcome, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = _settings(n_samples=400, abc=_block(leave_one_out=300))
    campaign = _campaign(tmp_path, n=400, noise=0.8)
    monkeypatch.setattr(writing, "sample_code_digest", lambda: "edited")
    later = _campaign(tmp_path / "later", n=400, noise=0.8)
    shutil.move(later["summaries"][-1], campaign["summaries"][-1])
    run_stage("abc", settings, **campaign)
    found = json.loads((tmp_path / "abc.json").read_text())
    assert found["verdict"] == "not usable"
    assert "summaries were made by 2 versions of the code" in found["reasons"][0]
    outcome.goes_on("the verdict is “not usable”, and says why", NOTHING)


@fault("Samples", "samples fail because of their parameters", "all with a relic below 1.1 keV", quick=True)
def test_failures_that_cluster_are_not_usable(tmp_path: Path, outcome: Outcome) -> None:
    m = draw_parameters(1, (0, 400), *PRIOR.model_dump().values()).m_th_kev
    settings = _settings(n_samples=400, abc=_block(leave_one_out=300))
    light = tuple(int(row) for row in np.flatnonzero(m < 1.1))
    run_stage("abc", settings, **_campaign(tmp_path, n=400, noise=0.8, failed=light))
    found = json.loads((tmp_path / "abc.json").read_text())
    assert found["verdict"] == "not usable"
    assert f"the {len(light)} of 400 samples that failed cluster: their m_th_kev is 1" in found["reasons"][0]
    assert found["bounds"]["q0455"]["prior_only_kev"] >= np.sort(m[m >= 1.1])[int(0.045 * (m >= 1.1).sum())]
    outcome.goes_on("the verdict is “not usable”, and says why", NOTHING)
