"""A grid campaign to its exclusion, on the smooth model and the scan operator of the finished campaign."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from warmlens.artifacts.file import open_artifact

from .conftest import Project

GRID = {
    "results": "results/grid",
    "campaign": {
        "design": "grid",
        "n_samples": 12,
        "chunk_size": 12,
        "grid": {"m_th_kev": [1.5, 5.0], "log10_m_halo_msun": [12.5, 13.4], "realizations": 3},
    },
    "dark_matter": {"m_th_kev": [1.0, 5.0], "log10_m_halo_msun": [12.0, 13.5]},
    "observation": {"kind": "artifact", "artifact": "results/tiny/observation.h5"},
    "abc": {"fraction": 0.5},
}
EXCLUSION = "results/grid/exclusion.h5"
PER_SAMPLE = ("halos", "deflections", "mocks", "scans", "summaries")


def _overlays(project: Project) -> list[str]:
    return [part for path in sorted(project.folder.glob("overlay-*.yaml")) for part in ("--configfile", str(path))]


def test_grid_to_exclusion(copy_of: Callable[[], Project]) -> None:
    project = copy_of()
    project.configure(GRID)
    taken = project.warmlens("branch", "results/tiny", *_overlays(project))
    assert taken.returncode == 0, taken.stderr
    assert "scan_operator: 2 linked, 0 in place, 0 to make" in taken.stdout
    planned = project.planned()
    assert {stage: planned.pop(stage) for stage in PER_SAMPLE} == dict.fromkeys(PER_SAMPLE, 1)
    assert planned.pop("exclusion") == planned.pop("manifest") == planned.pop("all") == 1
    assert set(planned) == {"figures_lens", "figures_samples"}  # neither abc nor anything of the smooth lens
    project.snakemake(EXCLUSION)
    results = project.folder / "results/grid"
    with open_artifact(results / "exclusion.h5", "exclusion") as artifact:
        meta = artifact.metadata
        assert artifact.array("table/m_th_kev").tolist() == [1.5, 5.0] * 6
        assert artifact.array("table/log10_m_halo_msun").tolist() == [12.5, 12.5, 13.4, 13.4] * 3
        assert np.array_equal(artifact.array("nodes/n_samples"), np.full((2, 2), 3))
        assert artifact.array("nodes/n_accepted").sum() == meta["n_accepted"] == 6
    shown = project.warmlens("result", "results/grid")
    assert shown.returncode == 0, shown.stderr
    assert "no halo mass is excluded at 95.45%" in shown.stdout
    assert "warning 6 accepted samples cannot exclude a halo mass" in shown.stdout.replace("\n", " ")
    audit = project.warmlens("audit", "results/grid")
    assert audit.returncode == 0, audit.stdout
    assert "exclusion" in project.warmlens("status", "results/grid").stdout
    campaign = {**GRID["campaign"], "n_samples": 16, "grid": {**GRID["campaign"]["grid"], "realizations": 4}}
    project.configure({**GRID, "campaign": campaign})
    assert project.planned(EXCLUSION) == {**dict.fromkeys(PER_SAMPLE, 1), "exclusion": 1}
