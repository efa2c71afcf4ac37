"""An answer that is not what the campaign gives: it is named, and neither printed, combined nor drawn."""

from __future__ import annotations

import dataclasses
import json
import logging
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from warmlens.artifacts.atomic import ArtifactError
from warmlens.audit.campaign import audit_campaign
from warmlens.audit.crate import write_crate
from warmlens.audit.manifest import make_manifest, write_manifest
from warmlens.audit.mending import Mending, mending, remove_files
from warmlens.campaign.answer import answer_problems
from warmlens.campaign.derived import derived_findings
from warmlens.campaign.status import read_campaign
from warmlens.config.model import Config
from warmlens.figures.registry import write_from_results
from warmlens.report.campaign_page import write_report
from warmlens.report.combination import combine_results
from warmlens.report.result import print_result
from warmlens.report.sample_page import write_sample

from ..reliability import Outcome, fault
from .conftest import Project
from .damage import flip_arrays, rewrite, swap, with_other_content

RESULTS = Path("results/tiny")
CHUNK = RESULTS / "summaries/chunk-0000000-0000007.h5"


@pytest.fixture
def config(copy_of: Callable[[], Project], monkeypatch: pytest.MonkeyPatch) -> Config:
    """The configuration of a copy of the finished campaign, in its folder."""
    monkeypatch.chdir(copy_of().folder)
    return read_campaign(RESULTS)


def _set_bound(text: str) -> str:
    numbers = json.loads(text)
    numbers["bounds"][numbers["headline"]]["value_kev"] += 1.0
    return json.dumps(numbers, indent=2) + "\n"


def _drop_warnings(text: str) -> str:
    return json.dumps({**json.loads(text), "warnings": []}, indent=2) + "\n"


def _say_twice(text: str) -> str:
    return text.replace('"n_samples": 14', '"n_samples": 9, "n_samples": 14')


EDITS: dict[str, tuple[str, Callable[[str], str]]] = {
    "bound": ("abc.json", _set_bound),
    "warnings": ("abc.json", _drop_warnings),
    "a key twice": ("abc.json", _say_twice),
    "no JSON": ("abc.json", lambda _: "["),
    "accepted": ("abc.csv", lambda text: text.replace("False", "True ", 1)),
    "a column": ("abc.csv", lambda text: text.replace("weight", "height", 1)),
    "a row": ("abc.csv", lambda text: text[: text.rstrip().rindex("\n") + 1]),
    "data": ("figures/posterior.csv", lambda text: text.replace("1", "2", 1)),
    "page": ("report.html", lambda text: text.replace("not usable", "measured", 1)),
}


def _edit(name: str) -> Path:
    file, change = EDITS[name]
    path = RESULTS / file
    text = path.read_text()
    assert change(text) != text
    rewrite(path, change(text).encode())
    return path


def _mending(config: Config) -> Mending:
    return mending(audit_campaign(config))


@fault(
    "Answers",
    "a number, a table, the data of a figure or the report is edited",
    "9 edits, times kept; manifest and RO-Crate are written again",
    quick=True,
)
def test_edited_file_is_named_whatever_the_manifest_says(config: Config, outcome: Outcome) -> None:
    for name, (file, _) in EDITS.items():
        original = (RESULTS / file).read_bytes()
        path = _edit(name)
        wrong = [finding for finding in derived_findings(config) if finding.kind != "manifest"]
        assert [finding.path for finding in wrong] == [path], name
        outcome.stops(f"{path}: {wrong[0].problem}", "altered: not what", path.name)
        rewrite(path, original)
    paths = [_edit(name) for name in ("accepted", "bound", "data", "page")]
    made, headers = make_manifest(config)
    write_manifest(made, RESULTS / "manifest.json")
    write_crate(RESULTS, made, headers, None)
    audit = audit_campaign(config)
    assert [finding.path for finding in audit.findings] == paths
    words = " ".join(map(str, paths))
    assert mending(audit).commands == (f"rm {words}", f"warmlens resume {RESULTS} --yes")
    assert "not what they derive from: abc.csv, abc.json, posterior.csv and 1 more" in answer_problems(config)[0]


@pytest.mark.parametrize("name", ["abc.csv", "abc.json"])
def test_numbers_of_the_answer_are_made_again_from_it(name: str, copy_of: Callable[[], Project]) -> None:
    project = copy_of()
    (project.results / name).unlink()
    planned = project.planned()
    assert planned.keys() >= {"abc", "report", "manifest"}
    assert not planned.keys() & {"halos", "scans", "summaries", "figures_lens"}


def test_a_folder_in_the_place_of_a_file_is_removed(config: Config) -> None:
    path = RESULTS / "abc.json"
    path.unlink()
    path.mkdir()
    mend = _mending(config)
    assert mend.commands[0] == f"rm -r {path}"
    remove_files(mend.remove)
    assert not path.exists()


def test_layout_of_the_numbers_is_free(config: Config) -> None:
    path = RESULTS / "abc.json"
    path.write_text(json.dumps(json.loads(path.read_text()), sort_keys=True))
    assert [finding.path.name for finding in derived_findings(config)] == ["manifest.json"]


def test_picture_of_other_artifacts(config: Config) -> None:
    """The picture is that of the ledger, but the ledger is of another artifact, another version, or no ledger."""
    path = RESULTS / "derived/psf.json"
    ledger = json.loads(path.read_text())
    pictures = [RESULTS / "figures/psf.png", RESULTS / "figures/psf.csv"]
    for change, kind, problem in (
        ({"inputs": {**ledger["inputs"], "smooth_model.h5": "0"}}, "inputs", "smooth_model.h5 has changed since"),
        ({"inputs": {**ledger["inputs"], "old.h5": "0"}}, "inputs", "made from old.h5, now no part of the"),
        ({"inputs": {}}, "inputs", "made without observation.h5"),
        ({"version": 1}, "settings", "made by version 1 of its code"),
    ):
        path.write_text(json.dumps(ledger | change))
        findings = [finding for finding in derived_findings(config) if finding.kind != "manifest"]
        assert [finding.path for finding in findings] == pictures
        assert {finding.kind for finding in findings} == {kind} and problem in findings[0].problem
    for text in ("[", "{}", "[" * 100_000, json.dumps(ledger | {"outputs": {"../../etc/passwd": "0"}})):
        path.write_text(text)
        assert [finding.path for finding in derived_findings(config)][:1] == [path]


def test_what_an_early_version_did_not_record_is_no_problem(config: Config) -> None:
    shutil.rmtree(RESULTS / "derived")
    manifest = json.loads((RESULTS / "manifest.json").read_text())
    manifest["files"] = [each for each in manifest["files"] if each["kind"] != "record"]
    (RESULTS / "manifest.json").write_text(json.dumps(manifest))
    (RESULTS / "ro-crate-metadata.json").unlink()
    audit = audit_campaign(config)
    assert audit.sound and "no record of what figures and report were made from" in audit.notes[0]
    with pytest.raises(ArtifactError, match="a manifest needs a finished campaign"):
        make_manifest(config)  # or none would notice when they are gone


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("manifest.json", '"seed": 1131,', '"seed": 1132,'),
        ("manifest.json", '"path": "report.html"', '"path": "report.htm"'),
        ("ro-crate-metadata.json", '"@id": "abc.csv"', '"@id": "abc.csw"'),
        ("ro-crate-metadata.json", "@graph", "@grape"),
    ],
)
def test_edited_manifest_or_crate_is_written_again(file: str, old: str, new: str, config: Config) -> None:
    text = (RESULTS / file).read_text()
    assert old in text
    (RESULTS / file).write_text(text.replace(old, new))
    named = {finding.path.name for finding in audit_campaign(config).findings}
    assert {file} <= named <= {"manifest.json", "ro-crate-metadata.json"}, "one is compared with the other"
    assert _mending(config).commands == (f"warmlens manifest {RESULTS}",)


def _other_seed() -> None:
    path = RESULTS / "config.json"
    config = json.loads(path.read_text())
    config["campaign"]["seed"] += 1
    path.write_text(json.dumps(config))


def _other_threshold() -> None:
    path = RESULTS / "config.json"
    config = json.loads(path.read_text())
    config["summaries"]["threshold"] = -3.0
    path.write_text(json.dumps(config))


USES: dict[str, Callable[[], object]] = {
    "result": lambda: print_result(RESULTS),
    "combine": lambda: combine_results([RESULTS, RESULTS], None),
    "report": lambda: write_report(RESULTS, Path("new.html")),
    "show": lambda: write_sample(RESULTS, 3, Path("new.html")),
    "figure": lambda: write_from_results("posterior", [RESULTS], Path("new.png")),
}


@fault(
    "Answers",
    "the configuration is another than that of the answer",
    "another seed, another threshold; result, combine, report, show and figure",
    quick=True,
)
@pytest.mark.parametrize("use", USES)
def test_answer_of_other_settings_is_of_no_use(use: str, config: Config, outcome: Outcome) -> None:
    for change, words in (
        (_other_seed, "campaign.seed was 1131, is now 1132"),
        (_other_threshold, "summaries.threshold was -4.0, is now -3.0"),
    ):
        change()
        with pytest.raises(ArtifactError) as error:
            USES[use]()
        outcome.stops(
            str(error.value), "belongs to other settings than config.json", f"`warmlens resume {RESULTS}`"
        )
        assert words in str(error.value)
    assert not Path("new.html").exists() and not Path("new.png").exists()
    assert "belongs to other settings" in answer_problems(read_campaign(RESULTS))[0]


@fault(
    "Answers",
    "an artifact has been exchanged since the answer was made from it",
    "a sound one with the same settings; result, combine, show and figure",
    quick=True,
)
@pytest.mark.parametrize("use", [use for use in USES if use != "report"])  # which says so on its page
def test_answer_of_a_broken_chain_is_of_no_use(use: str, config: Config, outcome: Outcome) -> None:
    with_other_content(CHUNK)
    with pytest.raises(ArtifactError) as error:
        USES[use]()
    outcome.stops(str(error.value), "has changed since", CHUNK.name, f"`warmlens resume {RESULTS}`")
    removed = {path.relative_to(RESULTS).as_posix() for path in _mending(config).remove}
    assert removed >= {"summaries/chunk-0000000-0000007.h5", "abc.h5", "report.html"}, "what records another, too"
    (RESULTS / "manifest.json").write_text("{")
    assert CHUNK in _mending(config).remove, "abc.h5 records its settings"


def test_answer_is_printed_where_its_origins_are_gone(config: Config, caplog: pytest.LogCaptureFixture) -> None:
    for path in (RESULTS / "scan_operator").glob("shard-*.h5"):
        path.unlink()  # most of the bytes
    with caplog.at_level(logging.WARNING):
        print_result(RESULTS)
    assert "are not there and were not compared" in caplog.text
    advice = _mending(config)
    assert not advice.remove and advice.commands == (f"warmlens resume {RESULTS} --yes",)


def test_commands_of_an_audit(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = RESULTS / "mocks/chunk-0000000-0000007.h5", RESULTS / "mocks/chunk-0000007-0000014.h5"
    swap(first, second)
    resume = f"warmlens resume {RESULTS} --yes"
    audit = audit_campaign(config)
    assert mending(audit).commands == (f"rm {first} {second}", resume)
    assert mending(audit, [Path("a b.yaml")]).commands[-1] == "warmlens run --configfile 'a b.yaml' --yes"
    folder = Path.cwd()
    monkeypatch.chdir("/")
    elsewhere = dataclasses.replace(
        audit,
        results=folder / RESULTS,
        artifacts=tuple(dataclasses.replace(each, path=folder / each.path) for each in audit.artifacts),
        files=(),
    )
    assert mending(elsewhere).commands == (f"cd {folder}", f"rm {first} {second}", resume)
    (folder / "Snakefile").unlink()
    assert "the commands work there" in mending(elsewhere).advice[0]


@fault(
    "Answers",
    "files of every kind are damaged, edited or gone",
    "the commands at the end of an audit are run as they are printed",
)
def test_commands_of_an_audit_mend_what_it_found(
    copy_of: Callable[[], Project], finished: Project, outcome: Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = copy_of()
    monkeypatch.chdir(project.folder)
    flip_arrays(RESULTS / "halos/chunk-0000000-0000007.h5")
    swap(RESULTS / "mocks/chunk-0000000-0000007.h5", RESULTS / "mocks/chunk-0000007-0000014.h5")
    with_other_content(RESULTS / "null/mocks.h5")
    for name in ("bound", "accepted", "data", "page"):
        _edit(name)
    (RESULTS / "figures/psf.png").unlink()
    (RESULTS / "manifest.json").write_text("{")
    told = json.loads(project.warmlens("audit", str(RESULTS), "--json").stdout)
    assert told["commands"] == [f"warmlens audit {RESULTS} --remove", f"warmlens resume {RESULTS} --yes"]
    for command in told["commands"]:
        done = project.warmlens(*shlex.split(command)[1:])
        assert done.returncode == 0, done.stderr
    assert audit_campaign(read_campaign(RESULTS)).sound
    outcome.same_digests(project.digests(), finished.digests())
