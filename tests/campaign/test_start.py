"""What a start finds in a results folder, what it would discard, when it asks; on artifacts without content."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import io
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.file import Dataset
from warmlens.artifacts.names import STARTED
from warmlens.audit.campaign import audit_campaign
from warmlens.audit.mending import mending
from warmlens.campaign.files import artifact_files, campaign_job, stage_file, stage_inputs, stage_spans
from warmlens.campaign.start import YES, Present, check_consent, compare_present, order_times, write_started
from warmlens.config.file import parse_config
from warmlens.config.model import Config
from warmlens.stage_table import STAGES, campaign_stages

from ..reliability import Outcome, fault

KEYS = ("science", "psf")


def changed(config: Config, **blocks: dict[str, Any]) -> Config:
    raw = config.model_dump()
    for name, values in blocks.items():
        raw[name].update(values)
    return parse_config(raw)


def make(config: Config, *stages: str) -> None:
    """Write artifacts of a campaign as its jobs do, with a number for content."""
    images = {f"{band}/{key}": Path(f"{band}-{key}.fits") for band in config.observation.bands for key in KEYS}
    for stage in stages:
        for number, span in enumerate(stage_spans(config, stage)):
            job = campaign_job(config, stage, span)
            data = Dataset(np.full(2, config.campaign.seed + number), "", ("n",), "a number")
            job.write({"x": data}, {}, span, sources=images if stage == "observation" else None)


@pytest.fixture(scope="module")
def template(paper_config: Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a finished campaign of two chunks and two shards on FITS images, without derived files."""
    folder = tmp_path_factory.mktemp("template")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(os, "fsync", lambda _: None)
        config = configured(paper_config)
        for band in config.observation.bands:
            for key in KEYS:
                Path(f"{band}-{key}.fits").write_text(f"{band} {key}")
        make(config, *campaign_stages(config))
    return folder


def configured(paper_config: Config) -> Config:
    files = {band: {key: f"$OWN/{band}-{key}.fits" for key in KEYS} for band in paper_config.observation.bands}
    return changed(
        paper_config,
        campaign={"n_samples": 10, "chunk_size": 5},
        scan={"step_arcsec": 0.5, "shard_size": 60},
        observation={"kind": "fits", "fits": files},
    ).model_copy(update={"results": "results/here"})


@pytest.fixture
def config(paper_config: Config, template: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Config:
    """A copy of it that a test may change, seen from its folder."""
    shutil.copytree(template, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OWN", str(tmp_path))
    monkeypatch.delenv(YES, raising=False)
    monkeypatch.setattr(os, "fsync", lambda _: None)
    return configured(paper_config)


def stages_of(present: Present) -> list[str]:
    return [stage for stage, times in present.stale.items() if times]


def planned(config: Config) -> set[str]:
    return {str(path) for path in artifact_files(config)}


def test_a_finished_campaign_fits(config: Config) -> None:
    present = compare_present(config)
    assert not present.broken and stages_of(present) == [] and present.describe() == ""
    check_consent(present, planned(config))
    assert order_times(present) == 0


@pytest.mark.parametrize(
    ("blocks", "first", "kept", "words"),
    [
        (
            {"campaign": {"seed": 2}},
            ["halos", "mocks"],
            ["observation", "scan_operator"],
            "seed was 1131, is now 2",
        ),
        (
            {"summaries": {"threshold": -5.0}},
            ["summaries", "observed_summary"],
            ["scans", "halos"],
            "summaries.threshold was -4.0, is now -5.0",
        ),
        (
            {"smooth_model": {"ridge": 1e-7}},
            ["smooth_model"],
            ["observation", "halos", "deflections"],
            "is now 1e-07",
        ),
    ],
)
def test_other_settings_are_named_with_both_values(
    config: Config, blocks: dict[str, Any], first: list[str], kept: list[str], words: str
) -> None:
    """Whatever Snakemake has recorded: only the artifacts are looked at."""
    present = compare_present(changed(config, **blocks))
    assert {present.broken[stage_file(config, stage, stage_spans(config, stage)[0])].kind for stage in first} == {
        "settings"
    }
    assert not {*kept} & {*stages_of(present)} and {*first, "abc"} <= {*stages_of(present)}
    assert words in present.describe() and "do not fit the configuration" in present.describe()


def test_more_samples_and_another_acceptance_discard_nothing(config: Config) -> None:
    present = compare_present(changed(config, campaign={"n_samples": 40}, abc={"fraction": 0.5}))
    assert stages_of(present) == ["abc"] and present.describe() == ""
    check_consent(present, planned(config))


def test_a_version_of_the_code_asks_too(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    write_started(compare_present(config))
    halos = dataclasses.replace(STAGES["halos"], version=7)
    monkeypatch.setitem(STAGES, "halos", halos)
    present = compare_present(config)
    assert "version of the stage's code was 1, is now 7" in present.describe()
    with pytest.raises(ArtifactError):
        check_consent(present, planned(config))


@fault("Origin", "an image is replaced by another one with an older time", "cp -p; then started again", quick=True)
def test_another_image_is_noticed_by_its_content(config: Config, outcome: Outcome) -> None:
    write_started(compare_present(config))
    image = Path("F814W-science.fits")
    image.write_text("another")
    os.utime(image, (1.0, 1.0))
    present = compare_present(config)
    assert stages_of(present)[0] == "observation" and "halos" not in stages_of(present)
    with pytest.raises(ArtifactError) as error:
        check_consent(present, planned(config))
    outcome.stops(str(error.value), "made from another F814W/science", "nothing was changed", "--yes")


def test_images_may_move_and_have_any_time(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("elsewhere").mkdir()
    for path in Path().glob("*.fits"):
        path.rename(Path("elsewhere") / path.name)
        (Path("elsewhere") / path.name).touch()
    monkeypatch.setenv("OWN", "elsewhere")
    assert not compare_present(config).broken


def test_an_image_that_is_not_there_is_no_other_image(config: Config) -> None:
    Path("F814W-psf.fits").unlink()
    assert not compare_present(config).broken


def test_an_observation_of_another_campaign_is_compared_by_its_content(config: Config, tmp_path: Path) -> None:
    source = tmp_path / "theirs.h5"
    shutil.copy(stage_file(config, "observation"), source)
    taken = changed(config, observation={"kind": "artifact", "artifact": str(source)})
    job = campaign_job(taken, "observation")
    job.write({"x": Dataset(np.zeros(2), "", ("n",), "")}, {}, sources={"artifact": source})
    assert stage_file(taken, "observation") not in compare_present(taken).broken
    campaign_job(config, "observation", output=source).write(
        {"x": Dataset(np.ones(2), "", ("n",), "")}, {}, sources={}
    )
    os.utime(source, (1.0, 1.0))
    assert compare_present(taken).broken[stage_file(taken, "observation")].kind == "inputs"


@pytest.mark.parametrize("spoil", [lambda path: path.write_bytes(b""), lambda path: path.write_bytes(b"x" * 900)])
def test_a_damaged_artifact_is_recomputed_with_what_was_made_from_it(
    config: Config, spoil: Callable[[Path], None]
) -> None:
    first, second = (stage_file(config, "mocks", span) for span in stage_spans(config, "mocks"))
    spoil(first)
    present = compare_present(config)
    assert first in present.broken and second not in present.broken
    assert {stage: len(times) for stage, times in present.stale.items() if times} == {
        "mocks": 1,
        "scans": 1,
        "summaries": 1,
        "abc": 1,
    }
    assert "mocks/chunk-0000000-0000005.h5: damaged" in present.describe()


@pytest.mark.parametrize("number", [errno.EIO, errno.EACCES, errno.ESTALE, errno.EMFILE])
def test_what_the_system_refuses_to_read_now_is_not_recomputed(
    config: Config, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = stage_file(config, "mocks", (0, 5))
    opened = h5py.File

    def refuse(name: Path, *arguments: Any, **options: Any) -> h5py.File:
        if Path(name).resolve() == path.resolve():
            raise OSError(number, f"Unable to open (errno = {number}, error message = '{os.strerror(number)}')")
        return opened(name, *arguments, **options)

    monkeypatch.setattr(h5py, "File", refuse)
    with pytest.raises(ArtifactError, match="cannot be read now"):
        compare_present(config)
    audit = audit_campaign(config)
    assert [record.path for record in audit.artifacts if record.verdict == "unreadable"] == [path]
    mend = mending(audit)
    assert path not in mend.remove, "it may be sound"
    assert f"make {path} readable: it may be sound" in mend.advice


@fault(
    "Origin", "an artifact was made from one that has been replaced", "a sound one of other content", quick=True
)
def test_a_replaced_input(config: Config, outcome: Outcome) -> None:
    write_started(compare_present(config))
    path = stage_file(config, "null_mocks")
    campaign_job(config, "null_mocks").write({"x": Dataset(np.ones(2), "", ("n",), "")}, {})
    present = compare_present(config)
    assert path not in present.broken and stages_of(present) == ["null_scans", "null_summaries", "abc"]
    check_consent(present, planned(config))  # the settings and images are those of the last start
    outcome.goes_on("what was made from it is recomputed, and a line says so", "nothing")


def test_a_deleted_artifact_is_made_with_what_was_made_from_it(config: Config) -> None:
    stage_file(config, "scan_design").unlink()
    assert {*stages_of(compare_present(config))} == {
        *("scan_operator", "observed_scan", "observed_summary", "scans", "summaries"),
        *("null_scans", "null_summaries", "abc"),
    }


@fault("Origin", "a campaign is copied without its times", "cp -r: every order of times", quick=True)
@pytest.mark.parametrize("order", [1, -1])
def test_times_out_of_order_lose_nothing(config: Config, outcome: Outcome, order: int) -> None:
    paths = list(artifact_files(config))
    for number, path in enumerate(paths[::order]):
        os.utime(path, ns=(10**18 - 10**9 * number,) * 2)
    note = Path("results/here/benchmarks/mocks/0000000-0000005.tsv")
    note.parent.mkdir(parents=True)
    note.touch()
    os.utime(note, (1.0, 1.0))
    present = compare_present(config)
    assert not present.broken
    assert (order_times(present) > 0) == (order == 1)
    for stage in campaign_stages(config):
        for span in stage_spans(config, stage):
            time = stage_file(config, stage, span).stat().st_mtime_ns
            for source in stage_inputs(config, stage, span).values():
                for path in [source] if isinstance(source, Path) else source:
                    assert path.stat().st_mtime_ns <= time
    assert note.stat().st_mtime_ns == stage_file(config, "deflections", (0, 5)).stat().st_mtime_ns
    assert order_times(compare_present(config)) == 0
    outcome.goes_on("the times are set, nothing is recomputed", "nothing")


def test_times_of_what_does_not_fit_are_left(config: Config) -> None:
    path = stage_file(config, "mocks", (0, 5))
    os.utime(path, (1.0, 1.0))
    order_times(compare_present(changed(config, campaign={"seed": 2})))
    assert path.stat().st_mtime == 1.0


class TestConsent:
    """When finished artifacts would be discarded."""

    @pytest.fixture
    def present(self, config: Config) -> Present:
        return compare_present(changed(config, campaign={"seed": 2}))

    @fault("Origin", "another seed in the same results", "records of Snakemake kept, lost or emptied", quick=True)
    def test_without_a_terminal_it_stops_and_names_the_ways_on(
        self, present: Present, outcome: Outcome, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for answer in ("", "ask"):
            monkeypatch.setenv(YES, answer)
            monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
            with pytest.raises(ArtifactError) as error:
                check_consent(present, planned(present.config))
            outcome.stops(
                str(error.value), "seed was 1131, is now 2", "--yes", "WARMLENS_YES=1", "warmlens branch"
            )
            assert "\n" not in str(error.value)

    def test_yes(self, present: Present, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv(YES, "1")
        check_consent(present, planned(present.config))

    @pytest.mark.parametrize(("typed", "agrees"), [("y", True), ("YES ", True), ("", False), ("n", False)])
    def test_a_terminal_is_asked(
        self, present: Present, typed: str, agrees: bool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv(YES, "ask")
        monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
        asked: list[str] = []
        monkeypatch.setattr("builtins.input", lambda prompt: asked.append(prompt) or typed)
        with contextlib.nullcontext() if agrees else pytest.raises(ArtifactError, match="nothing was changed"):
            check_consent(present, planned(present.config))
        assert "seed was 1131, is now 2" in asked[0]

    def test_only_what_is_planned_counts(self, present: Present) -> None:
        config = present.config
        check_consent(present, {str(stage_file(config, "observation")), str(stage_file(config, "abc"))})
        with pytest.raises(ArtifactError, match=r"1 finished artifact \(1 mocks; .* does not fit"):
            check_consent(present, {str(stage_file(config, "mocks", (0, 5)))})

    def test_a_change_is_asked_once(self, present: Present) -> None:
        write_started(present)  # agreed to, then interrupted
        check_consent(compare_present(present.config), planned(present.config))

    @pytest.mark.parametrize("content", ["", "[]", "{", "\0" * 100])
    def test_a_damaged_record_of_the_last_start_asks_again(self, present: Present, content: str) -> None:
        write_started(present)
        (Path(present.config.results) / STARTED).write_text(content)
        with pytest.raises(ArtifactError):
            check_consent(compare_present(present.config), planned(present.config))
