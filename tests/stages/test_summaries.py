"""Stage `summaries` on scan artifacts made by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from warmlens.artifacts.file import ArtifactError, Dataset, Provenance, open_artifact, write_artifact
from warmlens.campaign.settings import stage_settings
from warmlens.config.model import Config
from warmlens.products.samples import FAILED_HERE, SampleTable, null
from warmlens.sampling import draw_parameters
from warmlens.stages import summaries
from warmlens.stages.abc.tables import read_summaries, scalars
from warmlens.summaries.correlation import PairGeometry, correlation_function
from warmlens.summaries.response import amplitude_correlation, mean_square_significance

SHAPE, N, STEP = (60, 62), 3, 0.05


def _write(folder: Path, statistics: list[str], n: int | None, stage: str = "scans") -> Path:
    """Scans of n samples (the second one failed), or of the observation."""
    rng = np.random.default_rng(5)
    lead = () if n is None else (n,)
    valid = np.ones(SHAPE, dtype=bool)
    valid[0] = False
    datasets = {"raster/valid": Dataset(valid, "", ("y", "x"), "")}
    for band in ("A", "B"):
        arrays = {"delta_r": -20.0 * rng.random((*lead, *SHAPE)), "chi2": 100.0 + rng.random(lead)}
        if "amplitude" in statistics:
            arrays |= {"score": rng.normal(size=(*lead, *SHAPE)), "fisher": 1.0 + rng.random((*lead, *SHAPE))}
        for name, array in arrays.items():
            axes = (
                ("sample", "y", "x")[3 - np.ndim(array) :] if n is None else ("sample", "y", "x")[: np.ndim(array)]
            )
            datasets[f"{band}/{name}"] = Dataset(np.asarray(array), "", axes, "")
    stage = "observed_scan" if n is None else stage
    span = None if n is None else (0, n)
    if n is not None:
        table = SampleTable(draw_parameters(1, (0, n), (1.0, 5.0), (13.0, 13.5)))
        table.status[1], table.message[1] = FAILED_HERE, "mocks: broken"
        datasets |= table.datasets()
    provenance = Provenance(stage, {"scan": {"statistics": statistics}}, {}, span=span)
    write_artifact(folder / f"{stage}.h5", provenance, datasets, {"bands": ["A", "B"]})
    return folder / f"{stage}.h5"


@pytest.mark.parametrize("statistics", [["delta_r"], ["delta_r", "amplitude"]])
def test_every_summary_of_bands_and_their_sum(statistics: list[str], paper_config: Config, tmp_path: Path) -> None:
    settings = stage_settings(paper_config, "summaries").model_copy(
        update={"scan": paper_config.scan.model_copy(update={"statistics": statistics})}
    )
    scans, observed = _write(tmp_path, statistics, N), _write(tmp_path, statistics, None)
    summaries.run(settings, scans, tmp_path / "s.h5")
    summaries.run_observed(settings, observed, tmp_path / "o.h5")
    with open_artifact(scans, "scans") as found, open_artifact(tmp_path / "s.h5", "summaries") as summary:
        valid = found.array("raster/valid")
        pairs = PairGeometry.from_raster(valid, STEP, paper_config.summaries.max_separation_arcsec)
        both = {name: found.array(f"A/{name}") + found.array(f"B/{name}") for name in ("delta_r", "chi2")}
        for row in (0, 2):
            expected = correlation_function(both["delta_r"][row], pairs, -4.0)
            np.testing.assert_array_equal(summary["combined/correlation"][row], expected)
            assert summary["combined/chi2"][row] == both["chi2"][row]
            seen = both["delta_r"][row][valid]
            assert summary["combined/counts"][row].tolist() == [np.sum(seen < t) for t in (-25.0, -10.0, -4.0)]
            assert summary["A/chi2"][row] == found["A/chi2"][row]
            if "amplitude" in statistics:
                score, fisher = (found["A/" + k][row] + found["B/" + k][row] for k in ("score", "fisher"))
                assert summary["combined/mean_z2"][row] == mean_square_significance(score, fisher, valid)
                expected = amplitude_correlation(score, fisher, pairs)
                np.testing.assert_array_equal(summary["combined/amplitude_correlation"][row], expected)
        assert np.isnan(summary["combined/correlation"][1]).all()
        assert np.isnan(summary["combined/chi2"][1])

    found, grids = read_summaries([tmp_path / "s.h5"], tmp_path / "o.h5", None, np.array([True, False, True]))
    expected = {"correlation", "cumulative", "counts", "chi2"}
    assert set(found) == expected | ({"mean_z2", "amplitude_correlation"} if "amplitude" in statistics else set())
    for name, item in found.items():
        assert item.samples.shape == (2, *item.observed.shape), name
        assert item.null.shape == (0, *item.observed.shape), name
        assert np.isfinite(item.samples).all() and np.isfinite(item.observed).all()
    single = scalars(found, grids)
    assert list(single)[:5] == [*(f"positions_below_{t}" for t in (-25, -10, -4)), "correlation_at_0", "chi2"]
    assert ("mean_z2" in single) == ("amplitude" in statistics)
    np.testing.assert_array_equal(single["positions_below_-4"].samples, found["counts"].samples[:, 2])


def test_the_null_test_is_summarised_by_the_same_code(paper_config: Config, tmp_path: Path) -> None:
    """Same maps, same summaries; the artifact belongs to the null test, and no sample takes it for its own."""
    settings = stage_settings(paper_config, "summaries")
    summaries.run(settings, _write(tmp_path, ["delta_r"], N), tmp_path / "s.h5")
    summaries.run(settings, _write(tmp_path, ["delta_r"], N, null("scans")), tmp_path / "n.h5")
    with open_artifact(tmp_path / "s.h5", "summaries") as first, open_artifact(tmp_path / "n.h5") as second:
        assert second.stage == "null_summaries"
        np.testing.assert_array_equal(first.array("combined/counts"), second.array("combined/counts"))
    summaries.run_observed(settings, _write(tmp_path, ["delta_r"], None), tmp_path / "o.h5")
    with pytest.raises(ArtifactError, match="holds stage 'null_summaries', expected 'summaries'"):
        read_summaries([tmp_path / "n.h5"], tmp_path / "o.h5", None, np.ones(3, dtype=bool))
    good = np.array([True, False, True])
    found, _ = read_summaries([tmp_path / "s.h5"], tmp_path / "o.h5", tmp_path / "n.h5", good)
    np.testing.assert_array_equal(found["correlation"].null, found["correlation"].samples)  # the failed one is out
