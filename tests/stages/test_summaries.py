"""Stage `summaries` on scan artifacts made by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Dataset, open_artifact
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.config.model import Config
from warmlens.products.samples import FAILED_HERE, SampleTable
from warmlens.sampling import draw_parameters
from warmlens.stage_table import AbcSettings, stage_settings
from warmlens.stages.abc.tables import read_samples, scalars
from warmlens.stages.job import Job, make_job
from warmlens.summaries.correlation import PairGeometry, correlation_function
from warmlens.summaries.response import amplitude_correlation, mean_square_significance

from ..shared import run_stage

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


def _abc(config: Config, folder: Path, null: bool, summaries: str = "s.h5") -> Job[AbcSettings]:
    """Run of `abc` on these summaries."""
    write_artifact(folder / "smooth.h5", Provenance("smooth_model", {}), {}, {"problems": [], "notes": []})
    block = config.abc.model_copy(update={"max_failed_fraction": 0.5})
    settings = AbcSettings(seed=1, n_samples=N, dark_matter=config.dark_matter, abc=block, upstream={})
    inputs = {
        "summaries": folder / summaries,
        "observed_summary": folder / "o.h5",
        "smooth_model": folder / "smooth.h5",
    }
    return make_job(
        "abc", settings, folder / "abc.h5", inputs | ({"null_summaries": folder / "n.h5"} if null else {})
    )


@pytest.mark.parametrize("statistics", [["delta_r"], ["delta_r", "amplitude"]])
def test_every_summary_of_bands_and_their_sum(statistics: list[str], paper_config: Config, tmp_path: Path) -> None:
    settings = stage_settings(paper_config, "summaries").model_copy(
        update={"scan": paper_config.scan.model_copy(update={"statistics": statistics})}
    )
    scans, observed = _write(tmp_path, statistics, N), _write(tmp_path, statistics, None)
    run_stage("summaries", settings, tmp_path / "s.h5", scans=scans)
    run_stage("observed_summary", settings, tmp_path / "o.h5", observed_scan=observed)
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

    samples = read_samples(_abc(paper_config, tmp_path, null=False))
    found, grids = samples.summaries, samples.grids
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
    run_stage("summaries", settings, tmp_path / "s.h5", scans=_write(tmp_path, ["delta_r"], N))
    run_stage("null_summaries", settings, tmp_path / "n.h5", scans=_write(tmp_path, ["delta_r"], N, "null_scans"))
    with open_artifact(tmp_path / "s.h5", "summaries") as first, open_artifact(tmp_path / "n.h5") as second:
        assert second.stage == "null_summaries"
        np.testing.assert_array_equal(first.array("combined/counts"), second.array("combined/counts"))
    run_stage("observed_summary", settings, tmp_path / "o.h5", observed_scan=_write(tmp_path, ["delta_r"], None))
    with pytest.raises(ArtifactError, match="holds stage 'null_summaries', expected 'summaries'"):
        read_samples(_abc(paper_config, tmp_path, null=False, summaries="n.h5"))
    found = read_samples(_abc(paper_config, tmp_path, null=True)).summaries
    np.testing.assert_array_equal(found["correlation"].null, found["correlation"].samples)  # the failed one is out
