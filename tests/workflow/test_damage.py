"""Damaged, swapped and foreign artifacts: the stage that would read them says so, and nothing is made of them."""

from __future__ import annotations

import dataclasses
import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.chain import audit, check_chains
from warmlens.artifacts.file import open_artifact
from warmlens.campaign.files import stage_files
from warmlens.campaign.status import read_campaign
from warmlens.config.model import Config
from warmlens.halos.lens_halo import HaloGenerator
from warmlens.imaging.noise import NoiseModel
from warmlens.products.samples import FAILED_HERE, OK
from warmlens.stage_table import stage_digests
from warmlens.stages import deflections, scanner, summaries

from ..reliability import Outcome, fault
from .conftest import Project
from .damage import (
    READER,
    artifact_of,
    exchange_arrays,
    flip,
    flip_arrays,
    flip_metadata,
    places,
    restore,
    rewrite,
    rewrite_arrays,
    run_stage,
    swap,
    truncate,
    with_settings,
)

IN_PROCESS = "every stage's artifact, one by one; the stage that reads it is started"


@pytest.fixture(scope="module")
def config(finished: Project, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Config]:
    """A copy of the finished campaign, in which the tests run stages."""
    folder = tmp_path_factory.mktemp("damage")
    subprocess.run(["cp", "-a", f"{finished.results}/.", str(folder)], check=True)
    before = Path.cwd()
    os.chdir(folder.parent)
    yield read_campaign(folder).model_copy(update={"results": str(folder)})
    os.chdir(before)


@pytest.fixture(params=READER)
def damaged(request: pytest.FixtureRequest, config: Config, finished: Project) -> Iterator[tuple[str, Path]]:
    """A stage and its artifact, which is put back afterwards."""
    path = artifact_of(config, request.param)
    yield request.param, path
    restore(path, finished.results / path.relative_to(config.results))


def _refused(config: Config, stage: str, path: Path, tmp_path: Path, outcome: Outcome, *words: str) -> None:
    """Audit finds it, and the stage that reads the artifact names it, says what to do and writes nothing."""
    assert [finding.path for finding in audit({path: stage}, stage_digests(config))][:1] == [path]
    output = tmp_path / "output.h5"
    with pytest.raises(ArtifactError) as error:
        run_stage(config, READER[stage], output)
    outcome.stops(str(error.value), *words, path.name, "run the campaign")
    assert not output.exists()


@fault("Artifacts", "an artifact is cut short", IN_PROCESS, quick=True)
def test_truncated(damaged: tuple[str, Path], config: Config, tmp_path: Path, outcome: Outcome) -> None:
    stage, path = damaged
    truncate(path)
    _refused(config, stage, path, tmp_path, outcome, "not a readable HDF5 file")


@fault("Artifacts", "a bit is flipped in the arrays", IN_PROCESS, quick=True)
def test_flipped_in_an_array(damaged: tuple[str, Path], config: Config, tmp_path: Path, outcome: Outcome) -> None:
    stage, path = damaged
    flip_arrays(path)
    words = "is damaged, or is not what its stage writes"
    if stage != "abc":
        _refused(config, stage, path, tmp_path, outcome, words)
        return
    with pytest.raises(ArtifactError) as error:  # whose arrays the figures and the report read
        check_chains([path], stage_digests(config))
    outcome.stops(str(error.value), words, path.name, "run the campaign")


@fault("Artifacts", "arrays are exchanged within an artifact", IN_PROCESS, quick=True)
def test_exchanged_arrays(damaged: tuple[str, Path], config: Config, tmp_path: Path, outcome: Outcome) -> None:
    _changed_in_place(damaged, config, tmp_path, outcome, exchange_arrays)


@fault("Artifacts", "arrays are written anew in place", IN_PROCESS, quick=True)
def test_rewritten_arrays(damaged: tuple[str, Path], config: Config, tmp_path: Path, outcome: Outcome) -> None:
    _changed_in_place(damaged, config, tmp_path, outcome, rewrite_arrays)


def _changed_in_place(
    damaged: tuple[str, Path],
    config: Config,
    tmp_path: Path,
    outcome: Outcome,
    change: Callable[[Path], None],
) -> None:
    """HDF5 sees nothing: its checksums fit what is stored."""
    stage, path = damaged
    change(path)
    if stage != "abc":
        hashed = READER[stage] == "abc"  # which hashes all that it reads
        words = "its content does not match its digest" if hashed else "changed since it was written"
        _refused(config, stage, path, tmp_path, outcome, words)
        return
    with open_artifact(path) as artifact, pytest.raises(ArtifactError) as error:  # for the figures and the report
        for name in artifact.names:
            artifact.dataset(name)
    outcome.stops(str(error.value), "changed since it was written", path.name, "run the campaign")


@fault("Artifacts", "a bit is flipped in the numbers of the header", IN_PROCESS, quick=True)
def test_flipped_in_the_metadata(
    damaged: tuple[str, Path], config: Config, tmp_path: Path, outcome: Outcome
) -> None:
    stage, path = damaged
    with open_artifact(path) as artifact:
        large = len(artifact.text("metadata")) > 4096  # of which HDF5 has no checksum, but the seal
    flip_metadata(path)
    words = "have changed since it was written" if large else "is damaged, or is not what its stage writes"
    _refused(config, stage, path, tmp_path, outcome, words)


@fault(
    "Artifacts", "a bit is flipped anywhere", "12 places of every stage's artifact; all of it is read", quick=True
)
def test_flipped_anywhere(damaged: tuple[str, Path], outcome: Outcome) -> None:
    _, path = damaged
    content = path.read_bytes()

    def read() -> list[bytes | list[str]]:
        with open_artifact(path) as artifact:
            arrays = [name for name in artifact.names if artifact.file[name].dtype.kind != "S"]
            texts = [name for name in artifact.names if name not in arrays]
            header = [str((artifact.metadata, artifact.settings, artifact.inputs, artifact.digest, artifact.span))]
            return [*(artifact.array(name).tobytes() for name in arrays), *map(artifact.strings, texts), header]

    expected = read()
    for place in places(path, 12):
        flip(path, place)
        try:
            assert read() == expected, f"{path.name}: the flipped byte {place} was read"
        except ArtifactError as error:
            assert path.name in str(error) and "run the campaign again" in str(error)
        path.write_bytes(content)
    outcome.goes_on("stops, or the bit is in no number that is read", "nothing")


@fault("Artifacts", "an artifact is deleted", IN_PROCESS, quick=True)
def test_deleted(damaged: tuple[str, Path], config: Config, tmp_path: Path, outcome: Outcome) -> None:
    stage, path = damaged
    path.unlink()
    _refused(
        config, stage, path, tmp_path, outcome, "no such artifact; run the campaign, which makes what is missing"
    )


@fault("Artifacts", "an artifact of another stage is in its place", IN_PROCESS, quick=True)
def test_of_another_stage(damaged: tuple[str, Path], config: Config, tmp_path: Path, outcome: Outcome) -> None:
    stage, path = damaged
    other = artifact_of(config, "summaries" if stage == "halos" else "halos")
    rewrite(path, other.read_bytes())
    words = "but it holds" if stage == "scan_operator" else "holds stage"
    _refused(config, stage, path, tmp_path, outcome, words)


@fault("Artifacts", "two chunks of a stage are swapped", "file names exchanged, times kept", quick=True)
@pytest.mark.parametrize("stage", ["scan_operator", "halos", "deflections", "mocks", "scans", "summaries"])
def test_swapped_within_a_stage(stage: str, config: Config, tmp_path: Path, outcome: Outcome) -> None:
    first, second = stage_files(config, stage)[:2]
    swap(first, second)
    try:
        _refused(config, stage, first, tmp_path, outcome, "but it holds")
    finally:
        swap(first, second)


def _other_version(settings: dict[str, Any]) -> None:
    settings["stage_version"] += 1


def _other_seed(settings: dict[str, Any]) -> None:
    settings["seed"] += 1


def _other_config(settings: dict[str, Any]) -> None:
    key = next(key for key, value in settings.items() if isinstance(value, dict) and value)
    settings[key] = {**settings[key], "note": 1}


OTHERWISE = "a sound artifact with other settings in place of every stage's; the posterior is made"


@fault("Origin", "an artifact is of other code (stage version)", OTHERWISE, quick=True)
def test_other_code(damaged: tuple[str, Path], config: Config, outcome: Outcome) -> None:
    _foreign(damaged, config, outcome, _other_version)


@fault("Origin", "an artifact is of another configuration", OTHERWISE, quick=True)
def test_other_config(damaged: tuple[str, Path], config: Config, outcome: Outcome) -> None:
    _foreign(damaged, config, outcome, _other_config)


@fault("Origin", "an artifact is of another seed", OTHERWISE, quick=True)
@pytest.mark.parametrize("damaged", ["halos", "mocks", "null_mocks", "abc"], indirect=True)
def test_other_seed(damaged: tuple[str, Path], config: Config, outcome: Outcome) -> None:
    _foreign(damaged, config, outcome, _other_seed)


def _foreign(
    damaged: tuple[str, Path], config: Config, outcome: Outcome, change: Callable[[dict[str, Any]], None]
) -> None:
    _, path = damaged
    with_settings(path, change)
    with pytest.raises(ArtifactError) as error:
        check_chains([artifact_of(config, "abc")], stage_digests(config))
    outcome.stops(
        str(error.value),
        "made with other settings or an older version of its stage",
        path.name,
        "run the campaign",
    )


def _spoil_halo(halo: Any) -> Any:
    return dataclasses.replace(halo, f_sub=np.nan)


def _spoil_one_scan(maps: np.ndarray) -> np.ndarray:
    maps[:, 1] = np.nan  # of all samples at once
    return maps


SPOILT = {  # what is made to return NaN in its second call, once a sample or a band of it
    "halos": (HaloGenerator, "draw", _spoil_halo),
    "deflections": (deflections, "filtered_deflection", lambda field: field * np.nan),
    "mocks": (NoiseModel, "draw", lambda image: image * np.nan),
    "null_mocks": (NoiseModel, "draw", lambda image: image * np.nan),
    "scans": (scanner, "delta_r", _spoil_one_scan),
    "summaries": (summaries, "correlation_function", lambda values: values * np.nan),
}


@fault(
    "Samples", "a sample returns NaN", "one sample of every stage that works on samples, one by one", quick=True
)
@pytest.mark.parametrize("stage", SPOILT)
def test_not_a_number(
    stage: str, config: Config, tmp_path: Path, outcome: Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    owner, name, spoil = SPOILT[stage]
    work, calls = getattr(owner, name), []

    def spoilt(*arguments: Any, **options: Any) -> Any:
        calls.append(None)
        result = work(*arguments, **options)
        return spoil(result) if len(calls) == 2 else result

    monkeypatch.setattr(owner, name, spoilt)
    run_stage(config, stage, tmp_path / "output.h5")
    with open_artifact(tmp_path / "output.h5", stage) as artifact:
        status = artifact.array("samples/status")
        messages = "".join(artifact.strings("samples/message"))
    assert (status == FAILED_HERE).sum() == 1 and (status[status != FAILED_HERE] == OK).all()
    assert f"{stage}: FloatingPointError: " in messages and "not finite" in messages
    outcome.goes_on("the sample fails, the others go on", "that sample, counted as failed")
