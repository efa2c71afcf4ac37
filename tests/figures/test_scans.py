"""Maps of the scan and the plane of Delta R and R_sens hold what the artifacts hold."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Artifact, open_artifact
from warmlens.artifacts.names import CONFIG
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.campaign.files import stage_files
from warmlens.config.file import parse_config
from warmlens.config.model import Config
from warmlens.figures.delta_r import heavy_and_light
from warmlens.figures.draw.style import house_style
from warmlens.figures.inputs import find_inputs
from warmlens.figures.samples import warm_to_cold
from warmlens.figures.scan_plane import draw, read_lenses, read_sources

BANDS = ("F814W", "F555W")


def combined(artifact: Artifact, name: str, row: int | None = None) -> np.ndarray:
    """All bands together where the scan is valid [n]."""
    maps = [artifact.array(f"{band}/{name}") for band in BANDS]
    valid = artifact.array("raster/valid")
    return sum(data if row is None else data[row] for data in maps)[valid]


def test_delta_r_is_that_of_the_artifacts(campaign: Config, table_of: Callable[[str], pd.DataFrame]) -> None:
    table = table_of("delta_r")
    with open_artifact(stage_files(campaign, "observed_scan")[0]) as artifact:
        valid = artifact.array("raster/valid")
        np.testing.assert_allclose(table["x_arcsec"], artifact.array("raster/x")[valid], rtol=1e-5)
        for band in BANDS:
            for name in ("delta_r", "r_sens"):
                expected = artifact.array(f"{band}/{name}")[valid]
                np.testing.assert_allclose(table[f"{band}_observation_{name}"], expected, rtol=1e-5)
        both = table["F814W+F555W_observation_delta_r"]
        np.testing.assert_allclose(both, combined(artifact, "delta_r"), rtol=1e-5)
        fisher = combined(artifact, "fisher")
        significance = combined(artifact, "score")[fisher > 0] / np.sqrt(fisher[fisher > 0])
    shown = table["all_bands_observation_amplitude_sigma"].dropna()
    assert len(shown) >= len(significance) > 0
    assert shown.abs().max() == pytest.approx(np.abs(significance).max(), rel=1e-5)
    with open_artifact(stage_files(campaign, "scans")[0]) as artifact:
        m_th = artifact.array("samples/m_th_kev")
        for row in (int(np.argmin(m_th)), int(np.argmax(m_th))):
            expected = combined(artifact, "delta_r", row)
            np.testing.assert_allclose(table[f"F814W+F555W_sample_{row}_delta_r"], expected, rtol=1e-5)


def test_fig_3_shows_cold_samples_of_a_heavy_and_a_light_halo(
    campaign: Config, table_of: Callable[[str], pd.DataFrame]
) -> None:
    files = stage_files(campaign, "scans")
    (heavy_path, heavy), (light_path, light) = heavy_and_light(files)
    names = ("m_th_kev", "log10_m_halo_msun")
    tables = []
    for path in files:
        with open_artifact(path) as artifact:
            tables.append(np.column_stack([artifact.array(f"samples/{name}") for name in names]))
    unit = np.concatenate(tables)
    unit = (unit - unit.min(axis=0)) / np.ptp(unit, axis=0)
    assert heavy.sample_id == int(np.argmin(np.hypot(unit[:, 0] - 1.0, unit[:, 1] - 1.0)))
    assert light.sample_id == int(np.argmin(np.hypot(unit[:, 0] - 1.0, unit[:, 1])))
    assert heavy.log10_m_halo_msun > light.log10_m_halo_msun
    table = table_of("3")
    for path, sample in ((heavy_path, heavy), (light_path, light)):
        with open_artifact(path) as artifact:
            assert artifact.array("samples/sample_id")[sample.row] == sample.sample_id
            expected = artifact.array("F814W/delta_r")[sample.row][artifact.array("raster/valid")]
        np.testing.assert_allclose(table[f"F814W_sample_{sample.sample_id}_delta_r"], expected, rtol=1e-5)


def test_samples_go_from_warm_to_cold(campaign: Config) -> None:
    with open_artifact(stage_files(campaign, "scans")[1]) as artifact:
        samples = warm_to_cold(artifact)
        m_th = artifact.array("samples/m_th_kev")
    assert [sample.m_th_kev for sample in samples] == sorted(sample.m_th_kev for sample in samples)
    assert (samples[0].m_th_kev, samples[-1].m_th_kev) == (m_th.min(), m_th.max())
    assert len({sample.sample_id for sample in samples}) == 6
    assert samples[0].sample_id == 20 + samples[0].row


def test_scan_plane_has_every_valid_position_once_a_band(
    campaign: Config, table_of: Callable[[str], pd.DataFrame]
) -> None:
    table = table_of("scan_plane")
    assert list(table["scan"].unique()) == [*BANDS, "F814W + F555W"]
    with open_artifact(stage_files(campaign, "observed_scan")[0]) as artifact:
        valid = artifact.array("raster/valid")
        for band in BANDS:
            shown = table[table["scan"] == band]
            for name in ("delta_r", "r_sens"):
                np.testing.assert_allclose(shown[name], artifact.array(f"{band}/{name}")[valid], rtol=1e-5)


def test_figs_6_and_7_show_the_observation_and_the_mocks_with_residuals(
    campaign: Config, table_of: Callable[[str], pd.DataFrame]
) -> None:
    table = table_of("6")
    observation, first, second = table["scan"].unique()
    assert observation == "observation, 21 lens shapelets"
    assert first.startswith("mock 3: ")
    assert second.startswith("mock 25: ")
    assert table_of("7")["scan"].unique()[0] == r"observation, $n_{\rm max} = 6$ + nested $n_{\rm max} = 5$"
    with open_artifact(stage_files(campaign, "observed_scan")[0]) as artifact:
        expected = combined(artifact, "delta_r"), combined(artifact, "r_sens")
    shown = table[table["scan"] == observation]
    np.testing.assert_allclose(shown[["delta_r", "r_sens"]].T, expected, rtol=1e-5)
    with open_artifact(stage_files(campaign, "scans")[1]) as artifact:
        assert artifact.array("residuals/sample_id").tolist() == [25]
        expected = combined(artifact, "delta_r", 5), combined(artifact, "r_sens", 0)
    shown = table[table["scan"] == second]
    np.testing.assert_allclose(shown[["delta_r", "r_sens"]].T, expected, rtol=1e-5)


def test_several_campaigns_are_compared_without_mocks(campaign: Config, tmp_path: Path) -> None:
    """Of campaigns alike in what the figure compares the folders are named."""
    other = tmp_path / "other"
    other.symlink_to(campaign.results)
    inputs = find_inputs("6", [Path(campaign.results), other])
    assert set(inputs) == {f"{number}/{stage}" for number in (0, 1) for stage in ("observed_scan", "smooth_model")}
    names = [f"21 lens shapelets ({folder})" for folder in (Path(campaign.results).name, "other")]
    assert list(read_lenses(inputs)) == names


def test_without_residual_samples_the_key_is_named(
    campaign: Config, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    raw = campaign.model_dump()
    raw["scan"]["residual_samples"] = []
    for path in Path(campaign.results).iterdir():
        if path.name != CONFIG:
            (tmp_path / path.name).symlink_to(path)
    (tmp_path / CONFIG).write_text(parse_config(raw).model_dump_json())
    with caplog.at_level("INFO"):
        inputs = find_inputs("7", [tmp_path])
    assert len(read_sources(inputs)) == 1
    assert "scan.residual_samples" in caplog.text


def test_residual_samples_that_all_failed(campaign: Config, tmp_path: Path) -> None:
    path = tmp_path / "scans.h5"
    write_artifact(path, Provenance("scans", {}), {}, {"bands": list(BANDS)})
    inputs = find_inputs("6", [Path(campaign.results)])
    with pytest.raises(ArtifactError, match=r"samples of scan\.residual_samples have all failed"):
        read_lenses({key: path if key.startswith("0/scans") else other for key, other in inputs.items()})


def test_plane_has_every_position_once_in_each_panel() -> None:
    rng = np.random.default_rng(1)
    scans = {
        "F814W": pd.DataFrame({"delta_r": rng.normal(0.0, 20.0, 300), "r_sens": rng.lognormal(0.0, 1.0, 300)}),
        "F555W": pd.DataFrame({"delta_r": rng.normal(3.0, 2.0, 200), "r_sens": rng.lognormal(1.0, 1.0, 200)}),
    }
    with house_style():
        figure = draw(scans)
    top, plane, right = figure.axes
    for collection, scan in zip(plane.collections, scans.values(), strict=True):
        np.testing.assert_array_equal(collection.get_offsets(), scan)
    for ax, axis in ((top, 1), (right, 0)):
        # A step outline of counts: each bin appears twice, so that its sum is twice the number of positions.
        counts = [patch.get_xy()[:, axis].sum() for patch in ax.patches]
        assert counts == [pytest.approx(2 * 300, abs=1e-9), pytest.approx(2 * 200, abs=1e-9)]
    assert plane.get_legend_handles_labels()[1][:2] == ["F814W", "F555W"]
    assert plane.get_legend() is None  # it would hide positions
    colours = [tuple(collection.get_facecolor()[0][:3]) for collection in plane.collections]
    assert colours[0] != colours[1]
    up, down = (line.get_xydata() for line in plane.lines)
    np.testing.assert_allclose(up[:, 0], up[:, 1])
    np.testing.assert_allclose(down[:, 0], -down[:, 1])
    plt.close(figure)
