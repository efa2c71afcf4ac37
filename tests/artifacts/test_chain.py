from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np
import pytest

from warmlens.artifacts import chain as chain_module
from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.chain import Chain, audit, check_chains, examine, walk
from warmlens.artifacts.file import Dataset
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.audit.report import age
from warmlens.campaign.answer import differences
from warmlens.config.digest import settings_digest

SETTINGS = {"halos": {"a": 1}, "deflections": {"b": 2}, "mocks": {"c": 3}}
EXPECTED = {stage: settings_digest(settings) for stage, settings in SETTINGS.items()}


def _write(folder: Path, stage: str, value: float, **inputs: Path) -> Path:
    path = folder / f"{stage}.h5"
    datasets = {"x": Dataset(np.full(3, value), "", ("n",), "numbers")}
    write_artifact(path, Provenance(stage, SETTINGS[stage], inputs), datasets, {})
    return path


@pytest.fixture
def chain(tmp_path: Path) -> dict[Path, str]:
    halos = _write(tmp_path, "halos", 1.0)
    deflections = _write(tmp_path, "deflections", 2.0, halos=halos)
    mocks = _write(tmp_path, "mocks", 3.0, deflections=deflections)
    return {halos: "halos", deflections: "deflections", mocks: "mocks"}


def test_a_sound_chain(chain: dict[Path, str]) -> None:
    assert audit(chain, EXPECTED) == []
    check_chains([list(chain)[-1]], EXPECTED)


def _problems(chain: dict[Path, str], expected: dict[str, str] = EXPECTED) -> list[tuple[str, str]]:
    return [(finding.path.stem, finding.problem) for finding in audit(chain, expected)]


def test_missing(chain: dict[Path, str], tmp_path: Path) -> None:
    (tmp_path / "deflections.h5").unlink()
    assert _problems(chain) == [
        ("deflections", "missing"),
        ("mocks", "its input deflections (deflections.h5) is missing"),
    ]
    with pytest.raises(ArtifactError, match="is missing"):
        check_chains([tmp_path / "mocks.h5"], EXPECTED)


def test_altered_content(chain: dict[Path, str], tmp_path: Path) -> None:
    with h5py.File(tmp_path / "halos.h5", "r+") as file:
        file["x"][0] = 7.0
    assert _problems(chain) == [("halos", "altered: its content does not match its digest")]


def test_recomputed_input(chain: dict[Path, str], tmp_path: Path) -> None:
    _write(tmp_path, "halos", 1.5)
    assert _problems(chain) == [("deflections", "its input halos (halos.h5) has changed since")]
    with pytest.raises(ArtifactError, match=r"deflections\.h5: its input halos .* has changed since"):
        check_chains([tmp_path / "mocks.h5"], EXPECTED)


def test_other_settings(chain: dict[Path, str], tmp_path: Path) -> None:
    expected = {**EXPECTED, "deflections": settings_digest({"b": 3})}
    problem = "made with other settings or an older version of its stage"
    assert _problems(chain, expected) == [("deflections", problem)]
    with pytest.raises(ArtifactError, match=r"deflections\.h5: made with other settings"):
        check_chains([tmp_path / "mocks.h5"], expected)


def test_truncated(chain: dict[Path, str], tmp_path: Path) -> None:
    path = tmp_path / "mocks.h5"
    path.write_bytes(path.read_bytes()[:1000])
    ((name, problem),) = _problems(chain)
    assert name == "mocks"
    assert problem.startswith("damaged: ")


def test_a_record_has_the_header_of_an_artifact_and_what_is_wrong(chain: dict[Path, str], tmp_path: Path) -> None:
    _write(tmp_path, "halos", 1.5)
    (tmp_path / "mocks.h5").unlink()
    compared: list[Path] = []
    halos, deflections, mocks = examine(chain, EXPECTED, compared.append)
    assert [record.verdict for record in (halos, deflections, mocks)] == ["ok", "inputs", "missing"]
    assert halos.header is not None and deflections.header is not None and mocks.header is None
    assert halos.header.schema == "warmlens/halos"
    assert halos.header.settings_sha256 == EXPECTED["halos"]
    assert deflections.sources["halos"] == tmp_path / "halos.h5"
    assert set(compared) == set(chain)


def test_a_damaged_input_is_no_damage_of_what_was_made_from_it(chain: dict[Path, str], tmp_path: Path) -> None:
    (tmp_path / "halos.h5").write_bytes(b"none")
    assert [record.verdict for record in examine(chain, EXPECTED)] == ["damaged", "inputs", "ok"]


def test_several_chains_are_all_checked(chain: dict[Path, str], tmp_path: Path) -> None:
    check_chains([tmp_path / "halos.h5", tmp_path / "mocks.h5"], EXPECTED)
    _write(tmp_path, "halos", 1.5)
    check_chains([tmp_path / "halos.h5"], EXPECTED)
    with pytest.raises(ArtifactError, match=r"deflections\.h5: its input halos .* has changed since"):
        check_chains([tmp_path / "halos.h5", tmp_path / "mocks.h5"], EXPECTED)


def test_differences_of_settings_are_listed_by_name() -> None:
    now = {"stage_version": 2, "scan": {"step": 0.1, "window": None}, "upstream": {"halos": "b"}}
    before = {"scan": {"step": 0.2, "window": None}, "upstream": {"halos": "a"}, "stage_version": 1}
    assert differences(before, now).split(", ") == [
        "version of the stage's code was 1",
        "is now 2",
        "scan.step was 0.2",
        "is now 0.1",
        "the settings of halos have changed",
    ]
    assert differences(now, now) == ""


def test_age() -> None:
    now = datetime(2026, 3, 10, 12, 0, tzinfo=UTC)
    assert age("2026-03-10T11:58:30+00:00", now) == "1 min 30 s"
    assert age("2026-02-28T12:00:00+00:00", now) == "10 d"
    assert age("2026-03-11T12:00:00+00:00", now) == "in the future"
    assert age("yesterday", now) == "unknown"


def test_content_of_the_last_artifact_of_a_chain(chain: dict[Path, str], tmp_path: Path) -> None:
    with h5py.File(tmp_path / "mocks.h5", "r+") as file:
        file["x"][0] = 7.0
    with pytest.raises(
        ArtifactError, match=r"mocks\.h5: altered: its content does not match its digest; delete it"
    ):
        check_chains([tmp_path / "mocks.h5"], EXPECTED)


def test_an_input_is_not_opened_again(chain: dict[Path, str], monkeypatch: pytest.MonkeyPatch) -> None:
    compared = Chain(EXPECTED)
    monkeypatch.setattr(chain_module, "read_header", None)
    assert [compared.compare(path, stage).verdict for path, stage in chain.items()] == ["ok", "ok", "ok"]


def test_a_walk_ends_at_what_is_made_from_nothing(chain: dict[Path, str], tmp_path: Path) -> None:
    records = list(walk({tmp_path / "mocks.h5": "mocks"}, EXPECTED))
    assert [record.path.stem for record in records] == ["mocks", "deflections", "halos"]
    assert [record.sound_header().stage for record in records] == ["mocks", "deflections", "halos"]
    _write(tmp_path, "halos", 1.5)
    _, broken = walk({tmp_path / "mocks.h5": "mocks"}, EXPECTED)
    assert broken.verdict == "inputs", "and nothing behind it is examined"
    with pytest.raises(ArtifactError, match=r"deflections\.h5: its input halos .* has changed since; delete it"):
        broken.sound_header()


def test_a_stage_other_than_the_expected_one_is_damage(chain: dict[Path, str], tmp_path: Path) -> None:
    (record,) = walk({tmp_path / "halos.h5": "mocks"}, EXPECTED)
    assert record.verdict == "damaged" and "holds stage 'halos', expected 'mocks'" in record.findings[0].problem
