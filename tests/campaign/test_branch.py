"""A campaign started from another one, on artifacts that hold next to nothing."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.chain import audit
from warmlens.artifacts.file import Dataset, open_artifact
from warmlens.artifacts.names import CONFIG, SINGLE
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.campaign.branch import StageBranch, branch
from warmlens.campaign.files import stage_files
from warmlens.campaign.start import YES
from warmlens.config.file import parse_config
from warmlens.config.model import Config
from warmlens.imaging.grid import PixelGrid
from warmlens.stage_table import campaign_stages, stage_digests, stage_settings

INPUTS = {  # which stages each is made from
    "smooth_model": ("observation",),
    "scan_design": ("observation", "smooth_model"),
    "scan_operator": ("observation", "smooth_model", "scan_design"),
    "observed_scan": ("observation", "scan_operator"),
    "observed_summary": ("observed_scan",),
    "deflections": ("halos", "observation"),
    "mocks": ("deflections", "observation", "smooth_model"),
    "scans": ("mocks", "scan_operator"),
    "summaries": ("scans",),
    "null_mocks": ("observation", "smooth_model"),
    "null_scans": ("null_mocks", "scan_operator"),
    "null_summaries": ("null_scans",),
    "abc": ("summaries", "observed_summary", "smooth_model"),
}
FIT = ("smooth_model", "scan_design", "scan_operator", "observed_scan", "observed_summary")


@pytest.fixture
def config(paper_config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Config:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "fsync", lambda _: None)  # hundreds of files, none of them worth keeping
    return _changed(
        paper_config,
        "results/base",
        campaign={"n_samples": 10, "chunk_size": 5},
        scan={"step_arcsec": 0.5, "shard_size": 50},  # two shards
    )


def _changed(config: Config, results: str, **blocks: dict[str, Any]) -> Config:
    raw = config.model_dump()
    for name, values in blocks.items():
        raw[name].update(values)
    return parse_config({**raw, "results": results})


def _write(config: Config, stage: str, number: int, content: float) -> None:
    """An artifact of the stage that holds one number; of the observation, what every one has."""
    path = stage_files(config, stage)[number]
    inputs = {
        f"{name}/{i}": source
        for name in INPUTS.get(stage, ())
        for i, source in enumerate(stage_files(config, name))
        if len(stage_files(config, name)) != len(stage_files(config, stage)) or i == number
    }
    datasets = {"x": Dataset(np.full(3, content), "", ("n",), "")}
    metadata: dict[str, Any] = {}
    if stage == "observation":
        bands = config.observation.bands
        images = {"image": content, "sigma": 1.0, "mask": True}
        datasets = {
            f"{band}/{name}": Dataset(np.full((3, 3), value), "", ("y", "x"), "")
            for band in bands
            for name, value in images.items()
        }
        datasets |= {f"{band}/psf": Dataset(np.eye(3) / 3.0, "", ("y", "x"), "") for band in bands}
        noise = {band: {"background_rms": 1.0, "exposure_s": 1.0} for band in bands}
        grid = dataclasses.asdict(PixelGrid.centred((3, 3), 0.05))
        metadata = {"kind": "simulated", "grid": grid, "bands": bands, "noise": noise}
    edges = [int(edge) for edge in path.stem.split("-")[1:]]
    span = (edges[0], edges[1]) if edges else None
    provenance = Provenance(stage, stage_settings(config, stage).as_dict(), inputs, span=span)
    write_artifact(path, provenance, datasets, metadata)


def _run(config: Config, content: float = 1.0) -> None:
    """Make what is missing, as the workflow does."""
    for stage in campaign_stages(config):
        for number, path in enumerate(stage_files(config, stage)):
            if not path.exists():
                _write(config, stage, number, content)
    (Path(config.results) / CONFIG).write_text(config.model_dump_json())


@pytest.fixture
def base(config: Config) -> Config:
    _run(config)
    return config


def _taken(base: Config, results: str, **blocks: dict[str, Any]) -> Config:
    """A variant on the observation of the base."""
    source = str(Path(base.results) / SINGLE["observation"])
    return _changed(base, results, observation={"kind": "artifact", "artifact": source}, **blocks)


def _complete(stages: list[StageBranch]) -> set[str]:
    return {branched.stage for branched in stages if branched.complete}


def _sound(config: Config) -> bool:
    files = {path: stage for stage in campaign_stages(config) for path in stage_files(config, stage)}
    return audit(files, stage_digests(config)) == []


@pytest.mark.parametrize(
    ("blocks", "made"),
    [
        ({}, set()),
        ({"halos": {"preset": "calibrated"}}, {"halos", "deflections", "mocks", "scans", "summaries"}),
        ({"deflections": {"filter": "starlet"}}, {"deflections", "mocks", "scans", "summaries"}),
        ({"summaries": {"threshold": -5.0}}, {"observed_summary", "summaries", "null_summaries"}),
        (
            {"smooth_model": {"ridge": 1e-7}},
            {*FIT, "mocks", "scans", "summaries", "null_mocks", "null_scans", "null_summaries"},
        ),
    ],
)
def test_what_a_change_leaves_as_it_is_is_linked(base: Config, blocks: dict[str, Any], made: set[str]) -> None:
    variant = _taken(base, "results/elsewhere/variant", **blocks)
    stages = branch(Path(base.results), variant)
    assert _complete(stages) == {*campaign_stages(variant)[:-1]} - made
    for branched in stages:
        for path in stage_files(variant, branched.stage):
            original = Path(base.results) / path.relative_to(variant.results)
            if branched.stage == "observation":  # made of the base's, as old as that
                assert path.stat().st_mtime_ns == original.stat().st_mtime_ns
            elif branched.stage in made:
                assert not path.exists()
            else:
                assert path.samefile(original)
    _run(variant, 2.0)
    assert _sound(variant)
    assert _sound(base)
    again = branch(Path(base.results), variant)
    assert all(branched.n_there == branched.n_files for branched in again)


def test_a_damaged_or_missing_artifact_of_the_base_is_recomputed(
    base: Config, caplog: pytest.LogCaptureFixture
) -> None:
    first, second = stage_files(base, "halos")
    first.write_bytes(first.read_bytes()[:2000])
    stage_files(base, "scan_operator")[0].unlink()
    variant = _taken(base, "results/variant")
    stages = {branched.stage: branched for branched in branch(Path(base.results), variant)}
    assert (stages["halos"].n_linked, stages["halos"].n_files) == (1, 2)
    assert "halos/chunk-0000000-0000005.h5" in caplog.text
    assert stages["scan_operator"].n_linked == stages["scan_operator"].n_files - 1
    assert stages["observed_scan"].n_linked == 0  # one of its inputs is missing
    assert stages["deflections"].n_linked == 1
    _run(variant)
    assert _sound(variant)
    assert second.samefile(stage_files(variant, "halos")[1])


def test_what_the_system_refuses_to_read_now_is_not_removed(base: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    variant = _taken(base, "results/variant")
    branch(Path(base.results), variant)
    linked = stage_files(variant, "halos")[0]
    opened = h5py.File

    def refuse(name: Path, *arguments: Any, **options: Any) -> h5py.File:
        if Path(name) == linked:
            raise PermissionError(errno.EACCES, "Permission denied")
        return opened(name, *arguments, **options)

    monkeypatch.setattr(h5py, "File", refuse)
    with pytest.raises(ArtifactError, match="cannot be read now"):
        branch(Path(base.results), variant)
    assert linked.exists()


def test_an_interrupted_branch_is_completed(base: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    variant = _taken(base, "results/variant")
    link, n_left = os.link, [6]

    def interrupted(source: Path, target: Path) -> None:
        if not n_left[0]:
            raise KeyboardInterrupt
        n_left[0] -= 1
        link(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "link", interrupted)
        with pytest.raises(KeyboardInterrupt):
            branch(Path(base.results), variant)
    half = stage_files(variant, "smooth_model")[0]
    assert half.exists()
    half.unlink()
    half.write_bytes(b"half a copy")
    stages = branch(Path(base.results), variant)
    assert all(branched.complete for branched in stages)
    assert stages[1].n_linked == 1
    assert not list(Path(variant.results).rglob(".*tmp*"))
    _run(variant)
    assert _sound(variant)


def test_what_was_linked_before_a_change_goes(base: Config) -> None:
    branch(Path(base.results), _taken(base, "results/variant"))
    variant = _taken(base, "results/variant", halos={"preset": "calibrated"})
    stages = {branched.stage: branched for branched in branch(Path(base.results), variant)}
    assert stages["halos"].n_removed == stages["scans"].n_removed == 2
    assert not any(path.exists() for path in stage_files(variant, "halos"))
    assert all(path.exists() for path in stage_files(base, "halos"))
    back = branch(Path(base.results), _taken(base, "results/variant"))
    assert all(branched.complete for branched in back)


def test_copies_across_file_systems(base: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(source: Path, target: Path) -> None:
        raise OSError(errno.EXDEV, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", refuse)
    variant = _taken(base, "results/variant")
    assert all(branched.complete for branched in branch(Path(base.results), variant))
    path, original = stage_files(variant, "scans")[0], stage_files(base, "scans")[0]
    assert not path.samefile(original)
    assert path.stat().st_mtime_ns == original.stat().st_mtime_ns


def test_a_simulated_observation_of_other_halos_is_not_the_same(base: Config) -> None:
    variant = _changed(base, "results/variant", halos={"preset": "calibrated"})
    stages = branch(Path(base.results), variant)
    assert _complete(stages) == set()


def test_an_observation_of_other_content_takes_nothing_along(base: Config) -> None:
    """The settings of all stages are the same: only the content tells."""
    path = stage_files(base, "observation")[0]
    shutil.copy2(path, "kept.h5")
    path.unlink()
    _write(base, "observation", 0, 7.0)
    variant = _taken(base, "results/variant")
    assert _complete(branch(Path(base.results), variant)) == {"observation", "halos"}
    one_band = _taken(base, "results/one").model_copy()
    raw = one_band.model_dump()
    raw["observation"].update(artifact="kept.h5", bands=["F814W"])
    assert _complete(branch(Path(base.results), parse_config(raw))) == {"observation", "halos"}


def test_refusals(base: Config, tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="needs a folder of its own"):
        branch(Path(base.results), base)
    with pytest.raises(ArtifactError, match=r"nowhere/config\.json: no such file"):
        branch(Path("nowhere"), base)
    other = _taken(base, "results/other", halos={"preset": "calibrated"})
    _run(other)
    with pytest.raises(ArtifactError, match="holds a campaign that is no branch"):
        branch(Path(base.results), other.model_copy(update={"halos": base.halos}))
    with open_artifact(stage_files(other, "halos")[0]) as artifact:
        assert json.loads(json.dumps(artifact.settings))["halos"]["preset"] == "calibrated"


def test_what_a_branch_has_computed_itself_is_not_removed_unasked(
    base: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(YES, raising=False)
    variant = _taken(base, "results/variant", halos={"preset": "calibrated"})
    branch(Path(base.results), variant)
    _run(variant)
    other = _taken(base, "results/variant", halos={"preset": "calibrated"}, summaries={"threshold": -5.0})
    before = {path: path.stat().st_ino for path in Path("results/variant").rglob("*.h5")}
    with pytest.raises(ArtifactError, match=r"2 summaries.*summaries\.threshold was -4\.0, is now -5\.0.*--yes"):
        branch(Path(base.results), other)
    assert {path: path.stat().st_ino for path in Path("results/variant").rglob("*.h5")} == before
    assert next(
        each for each in branch(Path(base.results), other, yes=True) if each.stage == "summaries"
    ).n_removed
