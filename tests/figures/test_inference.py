"""Figures of the inference show the numbers of abc.json and the arrays of abc.h5."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.names import NUMBERS
from warmlens.campaign.files import stage_files
from warmlens.config.model import Config
from warmlens.figures import calibration, convergence, likelihood, predictive
from warmlens.figures.draw.style import house_style

Tables = Callable[[str], pd.DataFrame]


@pytest.fixture(scope="module")
def numbers(campaign: Config) -> dict[str, Any]:
    return json.loads((Path(campaign.results) / NUMBERS).read_text())


@pytest.fixture(scope="module")
def arrays(campaign: Config) -> Callable[[str], np.ndarray]:
    def read(name: str) -> np.ndarray:
        with open_artifact(stage_files(campaign, "abc")[0], "abc") as artifact:
            return artifact.array(name)

    return read


def test_posterior_has_all_samples_and_the_headline(
    table_of: Tables, numbers: dict[str, Any], arrays: Callable[[str], np.ndarray]
) -> None:
    for name in ("posterior", "5"):
        table = table_of(name)
        samples = table[table["panel"] == "samples"]
        for column in ("m_th_kev", "log10_m_halo_msun", "accepted"):
            np.testing.assert_allclose(samples[column], arrays(f"table/{column}"), rtol=1e-5)
        (bound,) = table[table["panel"] == "bound"].to_dict("records")
        head = numbers["bounds"][numbers["headline"]]
        assert bound["bound_kev"] == pytest.approx(head["value_kev"], rel=1e-5)
        assert bound["prior_only_kev"] == pytest.approx(head["prior_only_kev"], rel=1e-5)
        assert samples["accepted"].sum() == numbers["n_accepted"] == 12


def test_likelihood_has_the_band_the_crossings_and_every_bound(
    table_of: Tables, numbers: dict[str, Any], arrays: Callable[[str], np.ndarray]
) -> None:
    table = table_of("likelihood")
    ratio = table[table["panel"] == "likelihood ratio"]
    np.testing.assert_allclose(ratio["b"], arrays("likelihood/ratio"), rtol=1e-5)
    np.testing.assert_allclose(ratio[["b_p16", "b_p84"]].T, arrays("likelihood/band"), rtol=1e-5)
    crossings = table[table["panel"] == "crossing"]
    assert sorted(crossings["b"]) == [0.05, 0.1]
    masses = {entry["ratio"]: entry["m_kev"] for entry in numbers["likelihood_ratio"]["falls_to"].values()}
    for row in crossings.to_dict("records"):
        expected = masses[row["b"]]
        assert (
            np.isnan(row["m_th_kev"]) if expected is None else row["m_th_kev"] == pytest.approx(expected, rel=1e-5)
        )
    bounds = table[table["panel"] == "bound"].set_index("name")["bound_kev"]
    every = [numbers["bounds"], numbers["other_rules"], numbers["other_priors"]]
    assert len(bounds) == sum(map(len, every))
    head = numbers["bounds"][numbers["headline"]]["value_kev"]
    assert bounds.iloc[0] == bounds["headline"] == pytest.approx(head, rel=1e-5)
    inverse = numbers["other_priors"]["uniform_inverse_m"]["value_kev"]
    assert bounds[r"prior: uniform in $1/m_{\rm TH}$"] == pytest.approx(inverse, rel=1e-5)


def test_crossings_are_written_and_drawn_where_they_are() -> None:
    m_kev = np.linspace(1.0, 5.0, 41)
    ratio = np.exp(-8.0 / m_kev**2) / np.exp(-8.0 / 25.0)
    curve = pd.DataFrame({"m_th_kev": m_kev, "b": ratio, "b_p16": 0.8 * ratio, "b_p84": 1.2 * ratio})
    crossing = {"b": [0.1, 0.05], "m_th_kev": [1.75, np.nan], "mc_error_kev": [0.1, np.nan]}
    columns = ["name", "bound_kev", "mc_error_kev", "prior_only_kev"]
    bounds = pd.DataFrame([("headline", 2.0, 0.1, 1.2), ("refused", np.nan, np.nan, np.nan)], columns=columns)
    with house_style():
        figure = likelihood.draw({"likelihood ratio": curve, "crossing": pd.DataFrame(crossing), "bound": bounds})
        figure.canvas.draw()
    left, right = figure.axes
    assert [text.get_text().strip() for text in left.texts] == ["1/10: 1.75 $\\pm$ 0.10 keV", "1/20: not reached"]
    np.testing.assert_array_equal(left.lines[0].get_ydata(), np.maximum(ratio, 0.025))
    assert [text.get_text() for text in right.texts] == ["none"]
    plt.close(figure)


def test_coverage_is_that_of_the_json(
    table_of: Tables, numbers: dict[str, Any], arrays: Callable[[str], np.ndarray]
) -> None:
    table = table_of("calibration")
    measured = numbers["calibration"]
    coverage = table[table["panel"] == "coverage"].set_index("true_m_th")
    assert list(coverage.index) == ["all", "below 2 keV", "2 to 3 keV", "above 3 keV"]
    for name, expected in {
        "all": measured["coverage"][numbers["headline"]],
        **measured["coverage_by_true_mass"],
    }.items():
        for column in ("n", "n_covered", "fraction", "low", "high", "nominal"):
            assert coverage.loc[name, column] == pytest.approx(expected[column], rel=1e-5)
    trials = table[table["panel"] == "trials"]
    covered = (trials["true_m_th_kev"] >= trials["bound_kev"]).sum()
    assert covered == coverage.loc["all", "n_covered"]
    np.testing.assert_allclose(trials["true_m_th_kev"], arrays("trials/truth")[:, 0], rtol=1e-5)
    rank, ecdf, low, _ = arrays("ranks/m_th_kev")
    shown = table[table["panel"] == "ranks of m_th_kev"]
    np.testing.assert_allclose(shown["ecdf_minus_rank"], ecdf - rank, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(shown["band_low"], low - rank, rtol=1e-4, atol=1e-9)
    head = numbers["bounds"][numbers["headline"]]["value_kev"]
    assert table[table["panel"] == "observation"]["bound_kev"].item() == pytest.approx(head, rel=1e-5)


def test_trials_whose_truth_is_excluded_stand_out() -> None:
    coverage = pd.DataFrame(
        [
            {"true_m_th": name, "n": n, "n_covered": n, "fraction": 0.9, "low": 0.8, "high": 1.0, "nominal": 0.95}
            for name, n in (("all", 4), ("below 2 keV", 0))
        ]
    )
    rank = pd.DataFrame(
        {"rank": np.linspace(0.1, 0.9, 5), "ecdf_minus_rank": 0.0, "band_low": -0.3, "band_high": 0.3}
    )
    trials = {"true_m_th_kev": [1.0, 2.0, 3.0, 5.0], "bound_kev": [1.5, 1.2, np.nan, 1.4]}
    panels = {
        "coverage": coverage,
        "ranks of m_th_kev": rank,
        "ranks of log10_m_halo_msun": rank,
        "trials": pd.DataFrame(trials),
        "observation": pd.DataFrame({"bound_kev": [1.3]}),
        "expected of cold truths": pd.DataFrame({"bound_kev": [1.1, 1.2, 1.4]}),
        "null test": pd.DataFrame({"bound_kev": [1.0, 1.1, 1.3]}),
    }
    with house_style():
        figure = calibration.draw(panels)
        figure.canvas.draw()
    kept, missed = figure.axes[2].collections
    np.testing.assert_array_equal(kept.get_offsets(), [[2.0, 1.2], [5.0, 1.4]])
    np.testing.assert_array_equal(missed.get_offsets(), [[1.0, 1.5]])
    assert [label.get_text() for label in figure.axes[0].get_xticklabels()] == ["all\n(4)"]
    spans = [(patch.get_y(), patch.get_y() + patch.get_height()) for patch in figure.axes[2].patches]
    np.testing.assert_allclose(spans, [(1.1, 1.4), (1.0, 1.3)])
    plt.close(figure)


def test_convergence_has_every_step(table_of: Tables, numbers: dict[str, Any]) -> None:
    table = table_of("convergence")
    expected = pd.DataFrame(numbers["threshold_convergence"]["steps"])
    for name in ("fraction", "k", "raw_kev", "raw_error_kev"):
        np.testing.assert_allclose(table[name], expected[name], rtol=1e-5)
    assert table.loc[table["of_the_inference"] == 1, "fraction"].tolist() == [numbers["fraction"]]
    assert table["adjusted_kev"].isna().all()  # too few samples for it


def test_both_bounds_are_drawn_with_their_errors() -> None:
    steps = pd.DataFrame(
        {
            "fraction": [0.2, 0.1, 0.05],
            "k": [200, 100, 50],
            "raw_kev": [1.5, 1.8, 2.0],
            "raw_error_kev": [0.1, 0.1, 0.2],
            "adjusted_kev": [2.0, 2.1, np.nan],
            "adjusted_error_kev": [0.1, 0.1, np.nan],
            "of_the_inference": [0, 1, 0],
            "prior_only_kev": 1.2,
            "verdict": "converged",
        }
    )
    with house_style():
        figure = convergence.draw(steps)
        figure.canvas.draw()
    raw, adjusted = figure.axes[0].containers
    np.testing.assert_array_equal(raw[0].get_ydata(), steps["raw_kev"])
    np.testing.assert_array_equal(adjusted[0].get_ydata(), [2.0, 2.1])
    ends = [segment[:, 1] for segment in raw[2][0].get_segments()]
    np.testing.assert_allclose(ends, [[1.4, 1.6], [1.7, 1.9], [1.8, 2.2]])
    plt.close(figure)


def test_predictive_has_the_quantiles_on_the_grids_of_the_summaries(
    campaign: Config, table_of: Tables, numbers: dict[str, Any], arrays: Callable[[str], np.ndarray]
) -> None:
    table = table_of("predictive")
    with open_artifact(stage_files(campaign, "observed_summary")[0]) as artifact:
        grids = {"correlation": artifact.array("separation"), "cumulative": artifact.array("thresholds")}
        for kind, column in (("correlation", "dr_arcsec"), ("cumulative", "delta_r")):
            shown = table[table["panel"] == kind]
            np.testing.assert_allclose(shown[column], grids[kind], rtol=1e-5)
            np.testing.assert_allclose(shown["observed"], artifact.array(f"combined/{kind}"), rtol=1e-5)
            quantiles = shown[["p025", "p16", "p50", "p84", "p975"]].T
            np.testing.assert_allclose(quantiles, arrays(f"predictive/{kind}/quantiles"), rtol=1e-5, atol=1e-12)
            assert shown["p_value"].iloc[0] == pytest.approx(numbers["posterior_predictive_p"][kind], rel=1e-5)


def test_predictive_bands_are_named_and_drawn_in_order() -> None:
    panels = {}
    for kind, column, grid in (("correlation", "dr_arcsec", [0.0, 1.0]), ("cumulative", "delta_r", [-40.0, -4.0])):
        bands = dict(zip(predictive.QUANTILES, range(1, 6), strict=True))
        panels[kind] = pd.DataFrame({column: grid, "observed": [3.0, 6.0], **bands, "p_value": 0.5})
    with house_style():
        figure = predictive.draw(panels)
        figure.canvas.draw()
    for ax in figure.axes:
        reach = [band.get_paths()[0].vertices[:, 1] for band in ax.collections]
        assert [(ends.min(), ends.max()) for ends in reach] == [(1.0, 5.0), (2.0, 4.0)]
        median, observed = ax.lines
        assert (median.get_ydata().tolist(), observed.get_ydata().tolist()) == ([3.0, 3.0], [3.0, 6.0])
    plt.close(figure)


def test_information_has_every_set_and_leaves_refused_ones_empty(
    table_of: Tables, numbers: dict[str, Any]
) -> None:
    table = table_of("information").set_index("summaries")
    assert table.index[0] == "paper"
    assert set(table.index) == set(numbers["summary_sets"])
    for name, entry in numbers["summary_sets"].items():
        if "refused" in entry:
            assert table.loc[name].drop("prior_only_kev").isna().all()
        else:
            assert table.loc[name, "gain_nats"] == pytest.approx(entry["gain"]["gain_nats"], rel=1e-5)
            assert table.loc[name, "bound_kev"] == pytest.approx(entry["bound"]["value_kev"], rel=1e-5)
    assert any("refused" in entry for entry in numbers["summary_sets"].values())
