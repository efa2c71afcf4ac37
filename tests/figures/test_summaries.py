"""C(dr) and cumulative distributions: groups hold exactly their samples, the CSV their means."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import open_artifact
from warmlens.campaign.derived import figure_inputs
from warmlens.campaign.files import stage_files
from warmlens.config.model import Config
from warmlens.figures import correlation_by_halo, samples
from warmlens.figures.draw.style import house_style


@pytest.fixture(scope="module")
def every(campaign: Config) -> dict[str, np.ndarray]:
    """Parameters and C(dr) of all samples, straight from the artifacts."""
    parts: dict[str, list[np.ndarray]] = {}
    for path in stage_files(campaign, "summaries"):
        with open_artifact(path) as artifact:
            for name in ("samples/m_th_kev", "samples/log10_m_halo_msun", "combined/correlation"):
                parts.setdefault(name.partition("/")[2], []).append(artifact.array(name))
    return {name: np.concatenate(values) for name, values in parts.items()}


def test_terciles_have_the_means_of_their_samples(
    campaign: Config, table_of: Callable[[str], pd.DataFrame], every: dict[str, np.ndarray]
) -> None:
    table = table_of("correlation")
    shown = table[table["panel"] == "correlation"]
    for (low, high), group in shown[shown["group"] == "samples"].groupby(["m_th_low_kev", "m_th_high_kev"]):
        members = (every["m_th_kev"] > low - 1e-4) & (every["m_th_kev"] < high + 1e-4)
        assert set(group["n_samples"]) == {members.sum()}
        values = every["correlation"][members]
        np.testing.assert_allclose(group["mean"], values.mean(axis=0), rtol=1e-5)
        np.testing.assert_allclose(group["p84"], np.percentile(values, 84, axis=0), rtol=1e-5)
    with open_artifact(stage_files(campaign, "observed_summary")[0]) as artifact:
        for kind, grid, column in (
            ("correlation", "separation", "dr_arcsec"),
            ("cumulative", "thresholds", "delta_r"),
        ):
            seen = table[(table["panel"] == kind) & (table["group"] == "observation")]
            np.testing.assert_allclose(seen[column], artifact.array(grid), rtol=1e-5)
            np.testing.assert_allclose(seen["mean"], artifact.array(f"combined/{kind}"), rtol=1e-5)


def test_panels_of_fig_4_hold_exactly_the_samples_of_their_halo_masses(
    campaign: Config, every: dict[str, np.ndarray]
) -> None:
    figure = correlation_by_halo.read(figure_inputs(campaign, "4"))
    log10_mass, m_th = every["log10_m_halo_msun"], every["m_th_kev"]
    assert len(figure.panels) == len(figure.models) == 4
    for panel in figure.panels:
        inside = (log10_mass >= panel.low) & (log10_mass <= panel.high)
        members = np.concatenate([rows for _, rows in figure.members(panel)])
        assert sorted(members) == np.flatnonzero(inside).tolist() == panel.rows.tolist()
        for model, rows in figure.members(panel):
            group = figure.models[model]
            assert ((m_th[rows] >= group.low) & (m_th[rows] <= group.high)).all()


def test_table_of_fig_4_has_means_and_single_samples(
    table_of: Callable[[str], pd.DataFrame], every: dict[str, np.ndarray]
) -> None:
    table = table_of("4")
    means = table[table["curve"] == "mean"]
    keys = ["log10_m_halo_low_msun", "log10_m_halo_high_msun", "m_th_low_kev", "m_th_high_kev"]
    for (low, high, warm, cold), group in means.groupby(keys):
        rows = (every["log10_m_halo_msun"] > low - 1e-4) & (every["log10_m_halo_msun"] < high + 1e-4)
        rows &= (every["m_th_kev"] > warm - 1e-4) & (every["m_th_kev"] < cold + 1e-4)
        assert set(group["n_samples"]) == {rows.sum()}
        np.testing.assert_allclose(group["c"], every["correlation"][rows].mean(axis=0), rtol=1e-5, atol=1e-12)
    singles = table[table["curve"] == "sample"]
    for sample, group in singles.groupby("sample_id"):
        np.testing.assert_allclose(group["c"], every["correlation"][int(sample)], rtol=1e-5, atol=1e-12)


def test_a_grid_is_grouped_by_its_nodes(campaign: Config) -> None:
    """As a grid campaign of 2 halo masses and 5 relics has it; a group too many would split a node."""
    data = samples.read_summaries(figure_inputs(campaign, "4"))
    n = len(data.parameters)
    halo, relic = np.divmod(np.arange(n) % 10, 5)
    relics_kev = np.array([1.0, 2.0, 3.3, 5.0, 10.0])
    grid = data.parameters.assign(m_th_kev=relics_kev[relic], log10_m_halo_msun=12.0 + halo)
    figure = correlation_by_halo.group_summaries(replace(data, parameters=grid))
    assert [(panel.low, panel.high) for panel in figure.panels] == [(12.0, 12.0), (13.0, 13.0)]
    assert [group.low for group in figure.models] == [1.0, 2.0, 3.3, 5.0, 10.0]
    for number, panel in enumerate(figure.panels):
        for model, rows in figure.members(panel):
            assert rows.tolist() == np.flatnonzero((halo == number) & (relic == model)).tolist()
    with house_style():
        drawn = correlation_by_halo.draw(figure)
    titles = [ax.get_title() for ax in drawn.axes]
    assert ["= 12, 20 samples" in titles[0], "= 13, 20 samples" in titles[1], len(titles)] == [True, True, 2]
    plt.close(drawn)


def test_groups_are_nodes_or_ranges() -> None:
    nodes = correlation_by_halo.group_values(np.array([2.0, 1.0, 2.0, np.inf]), 4)
    assert [(group.low, group.rows.tolist()) for group in nodes] == [(1.0, [1]), (2.0, [0, 2]), (np.inf, [3])]
    values = np.random.default_rng(0).random(50)
    ranges = correlation_by_halo.group_values(values, 4)
    assert [group.rows.size for group in ranges] == [13, 13, 12, 12]
    assert all(low.high <= high.low for low, high in pairwise(ranges))


def test_too_few_samples_are_refused(campaign: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(samples, "MIN_TO_GROUP", 41)
    with pytest.raises(ArtifactError, match="40 samples are left, fewer than 41"):
        samples.read_summaries(figure_inputs(campaign, "correlation"))


def test_failed_samples_are_left_out(campaign: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    read = samples.read_samples
    monkeypatch.setattr(samples, "read_samples", lambda artifact: read(artifact).drop(index=[0, 4]))
    data = samples.read_summaries(figure_inputs(campaign, "correlation"))
    assert data.parameters["sample_id"].tolist() == [i for i in range(40) if i % 20 not in (0, 4)]
    assert all(len(values) == 36 for values in data.samples.values())
