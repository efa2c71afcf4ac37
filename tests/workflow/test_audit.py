"""Audit, manifest and crate of a finished campaign, and what a change of any of its files does to them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rocrate.rocrate import ROCrate

from warmlens.artifacts.atomic import file_digest
from warmlens.audit.campaign import CampaignAudit, audit_campaign
from warmlens.campaign.status import read_campaign

from .conftest import Project

CHUNK = "summaries/chunk-0000000-0000007.h5"


def _audit(project: Project) -> CampaignAudit:
    return audit_campaign(read_campaign(project.results))


def _problems(project: Project) -> dict[str, str]:
    return {_name(project, finding.path): finding.kind for finding in _audit(project).findings}


def _name(project: Project, path: Path) -> str:
    return path.relative_to(project.results).as_posix()


def test_audit_as_json(finished: Project) -> None:
    done = finished.warmlens("audit", "results/tiny", "--json")
    assert done.returncode == 0, done.stderr
    assert done.stderr == "", "no progress where there is no terminal"
    told: dict[str, Any] = json.loads(done.stdout)
    assert told["format"] == "warmlens/audit" and told["sound"] and told["manifest"] == "present"
    assert {item["path"]: item["digest"] for item in told["artifacts"]} == finished.digests()
    assert {item["verdict"] for item in (*told["artifacts"], *told["files"])} == {"ok"}
    assert "report.html" in {item["path"] for item in told["files"]}
    assert told["notes"] == told["problems"] == told["advice"] == told["commands"] == []


def test_manifest_lists_every_file_as_it_is(finished: Project) -> None:
    text = (finished.results / "manifest.json").read_text()
    manifest = json.loads(text)
    listed = {item["path"]: item for item in manifest["files"]}
    there = {_name(finished, path) for path in finished.results.rglob("*") if path.is_file()}
    apart = ("logs/", "benchmarks/", "settings/", "manifest.json", "ro-crate-metadata.json")
    assert set(listed) == {name for name in there if not name.startswith(apart)}
    for name, item in listed.items():
        path = finished.results / name
        assert (item["size"], item["sha256"]) == (path.stat().st_size, file_digest(path)), name
    artifacts = {name: item["digest"] for name, item in listed.items() if item["kind"] == "artifact"}
    assert artifacts == finished.digests()
    assert manifest["config"] == json.loads((finished.results / "config.json").read_text())
    assert str(finished.folder) not in text


def test_crate_is_read_back(finished: Project) -> None:
    path = finished.results / "ro-crate-metadata.json"
    assert str(finished.folder) not in path.read_text()
    assert not re.search(r'"@id": "(/|file:)', path.read_text())
    crate = ROCrate(finished.results)
    root = crate.root_dataset
    assert root.id == "./" and root["name"] == "warmlens campaign tiny" and "--license" in root["license"]
    names = {entity.id for entity in crate.data_entities}
    assert all((finished.results / name).exists() for name in names)
    assert {"abc.h5", "abc.json", "report.html", "manifest.json", "figures/posterior.png", "scans/"} <= names
    assert not any(name.startswith("scan_operator") for name in names)
    actions = {entity.id: entity for entity in crate.contextual_entities if entity.type == "CreateAction"}
    assert {entity.id for entity in actions["#abc"]["object"]} == {
        "summaries/",
        "observed_summary.h5",
        "smooth_model.h5",
        "null/summaries.h5",
    }
    assert actions["#abc"]["instrument"]["name"] == "warmlens"


def test_manifest_by_hand_names_the_license(copy_of: Callable[[], Project]) -> None:
    project = copy_of()
    license_url = "https://creativecommons.org/licenses/by/4.0/"
    done = project.warmlens("manifest", "results/tiny", "--license", license_url)
    assert done.returncode == 0, done.stderr
    assert ROCrate(project.results).root_dataset["license"] == license_url
    assert _audit(project).sound


def test_a_changed_file_is_named(copy_of: Callable[[], Project]) -> None:
    project = copy_of()
    with (project.results / "abc.csv").open("a") as table:
        table.write("0\n")
    picture = project.results / "figures/posterior.png"
    picture.write_bytes(picture.read_bytes()[:-1] + b"\0")
    (project.results / "report.html").unlink()
    (project.results / "summaries/chunk-0000000-0000014.h5").write_bytes(b"of another chunk size")
    assert _problems(project) == {
        "abc.csv": "altered",
        "figures/posterior.png": "altered",
        "report.html": "missing",
    }
    (note,) = _audit(project).notes
    assert "chunk-0000000-0000014.h5: no part of this campaign, and nothing reads it; `rm /" in note
    refused = project.warmlens("manifest", "results/tiny")
    assert refused.returncode == 1
    assert "report.html: no such file (1 of the campaign missing)" in refused.stderr


def test_a_campaign_without_manifest(copy_of: Callable[[], Project]) -> None:
    project = copy_of()
    (project.results / "manifest.json").unlink()
    assert _problems(project) == {"manifest.json": "missing"}
    (project.results / "report.html").unlink()
    found = _audit(project)
    assert found.sound and found.manifest == "none"
    assert "not finished (1 files to make)" in found.notes[0]


def test_a_hostile_manifest(copy_of: Callable[[], Project]) -> None:
    project = copy_of()
    path = project.results / "manifest.json"
    outside = path.read_text().replace('"path": "abc.csv"', '"path": "../../../etc/passwd"')
    for content in (outside, "[", "{}", "[" * 100_000, '{"files": "\\ud800"}'):
        path.write_text(content)
        assert _problems(project) == {"manifest.json": "damaged"}
