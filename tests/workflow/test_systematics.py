"""`warmlens systematics` on the finished campaign: what is shared and computed, and how failures are reported."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import yaml

from warmlens.artifacts.file import open_artifact

from .conftest import Project

VARIANTS = {
    "equal": {"group": "none", "description": "nothing is changed", "overlay": {}},
    "halos": {"group": "halos", "description": "the paper's", "overlay": {"halos": {"preset": "paper"}}},
    "gated": {
        "group": "lens",
        "description": "a gate that no fit passes",
        "overlay": {"smooth_model": {"allow_poor_fit": False, "chi2_red_range": [0.1, 0.2]}},
    },
    "scan": {
        "group": "scan",
        "description": "the observation alone",
        "bound": False,
        "overlay": {"summaries": {"threshold": -6.0}},
    },
}


def _times(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in sorted(folder.rglob("*.h5"))}


def test_systematics(copy_of: Callable[[], Project]) -> None:
    project = copy_of()
    project.configure({"campaign": {"n_samples": 7}})  # one chunk
    for path in project.results.glob("*/chunk-0000007-*.h5"):
        path.unlink()
    block = {"base": ["absent.yaml"], "results": "results/systematics", "variants": VARIANTS}
    (project.folder / "mine.yaml").write_text(yaml.safe_dump(block, sort_keys=False))
    before = _times(project.results)
    del before["abc.h5"]  # of more samples: recomputed
    overlays = ("--configfile", "overlay-0.yaml", "--configfile", "overlay-1.yaml")  # in place of the file's base
    done = project.warmlens("systematics", "--config", "mine.yaml", *overlays, "--cores", "2")
    assert done.returncode == 0, done.stdout + done.stderr
    folder = project.folder / "results/tiny_systematics"
    after = _times(project.results)
    del after["abc.h5"]
    assert after == before, "the base was touched"

    def shared(variant: str) -> set[str]:
        paths = (folder / variant).rglob("*.h5")
        relative = [path.relative_to(folder / variant) for path in paths]
        return {str(path) for path in relative if (folder / variant / path).samefile(project.results / path)}

    assert set(before) - shared("equal") == {"observation.h5"}
    fit = {name for name in before if "chunk" not in name} - {"observation.h5"}
    assert shared("halos") == fit
    assert not (folder / "scan/abc.h5").exists()
    rows = {row["name"]: row for row in json.loads((folder / "systematics.json").read_text())}
    assert list(rows)[:5] == ["base", *VARIANTS]
    with open_artifact(project.results / "abc.h5") as ours, open_artifact(folder / "equal/abc.h5") as other:
        assert other.digest == ours.digest
        bound = ours.metadata["bounds"]["q0455"]
        priors = ours.metadata["other_priors"]
    assert (rows["base"]["bound_kev"], rows["base"]["mc_error_kev"]) == (bound["value_kev"], bound["mc_error_kev"])
    equal = rows["equal"]
    assert (equal["shift_kev"], equal["computed"], equal["n_in_common"]) == (0.0, ["abc"], equal["n_accepted"])
    scan = ("n_below", "c0", "min_delta_r", "chi2_red", "null_n_below")
    assert all(equal[name] == rows["base"][name] == rows["halos"][name] for name in scan)
    assert rows["halos"]["computed"] == ["halos", "deflections", "mocks", "scans", "summaries", "abc"]
    with open_artifact(folder / "halos/abc.h5") as artifact:
        assert rows["halos"]["bound_kev"] == artifact.metadata["bounds"]["q0455"]["value_kev"]
    assert rows["gated"]["state"] == "failed"
    assert "chi2_red" in rows["gated"]["reason"]
    assert rows["gated"]["bound_kev"] is rows["gated"]["n_below"] is None
    assert rows["scan"]["bound_kev"] is None
    assert rows["scan"]["n_below"] < rows["base"]["n_below"]  # the threshold is lower
    with open_artifact(project.results / "null/scans.h5") as artifact:
        below = (artifact["F814W/delta_r"][:] + artifact["F555W/delta_r"][:])[
            :, artifact.array("raster/valid")
        ] < -4.0
    assert rows["base"]["null_n_below"] == sorted(below.sum(axis=1))[1]  # of three
    assert rows["scan"]["null_n_below"] is rows["base"]["mean_z2"] is rows["base"]["null_mean_z2"] is None
    assert rows["normal_13.9_0.3"]["bound_kev"] == priors["normal_13.9_0.3"]["value_kev"]
    assert pd.read_csv(folder / "systematics.csv")["name"].tolist() == list(rows)
    assert (folder / "systematics.png").stat().st_size > 10_000
    assert "variant 4 of 4: scan" in done.stdout
    for variant in ("equal", "halos"):
        audit = project.warmlens("audit", f"results/tiny_systematics/{variant}")
        assert audit.returncode == 0, audit.stdout

    made = {variant: _times(folder / variant) for variant in VARIANTS}
    fewer = {name: VARIANTS[name] for name in ("halos", "gated")}
    (project.folder / "mine.yaml").write_text(yaml.safe_dump(block | {"variants": fewer}, sort_keys=False))
    again = project.warmlens("systematics", "--config", "mine.yaml", *overlays, "--cores", "2")
    assert again.returncode == 0, again.stdout + again.stderr
    assert {variant: _times(folder / variant) for variant in VARIANTS} == made
    kept = {row["name"]: row for row in json.loads((folder / "systematics.json").read_text())}
    assert kept == {name: row for name, row in rows.items() if name not in ("equal", "scan")}
