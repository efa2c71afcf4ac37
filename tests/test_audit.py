from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from warmlens.artifacts import ArtifactError, Dataset, Provenance, settings_digest, write_artifact
from warmlens.audit import audit, check_chain

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
    check_chain(list(chain)[-1], EXPECTED)


def _problems(chain: dict[Path, str], expected: dict[str, str] = EXPECTED) -> list[tuple[str, str]]:
    return [(finding.path.stem, finding.problem) for finding in audit(chain, expected)]


def test_missing(chain: dict[Path, str], tmp_path: Path) -> None:
    (tmp_path / "deflections.h5").unlink()
    assert _problems(chain) == [
        ("deflections", "missing"),
        ("mocks", "its input deflections (deflections.h5) is missing"),
    ]
    with pytest.raises(ArtifactError, match="is missing"):
        check_chain(tmp_path / "mocks.h5", EXPECTED)


def test_altered_content(chain: dict[Path, str], tmp_path: Path) -> None:
    with h5py.File(tmp_path / "halos.h5", "r+") as file:
        file["x"][0] = 7.0
    assert _problems(chain) == [("halos", "altered: its content does not match its digest")]


def test_input_made_anew(chain: dict[Path, str], tmp_path: Path) -> None:
    _write(tmp_path, "halos", 1.5)
    assert _problems(chain) == [("deflections", "its input halos (halos.h5) has changed since")]
    with pytest.raises(ArtifactError, match=r"deflections\.h5: its input halos .* has changed since"):
        check_chain(tmp_path / "mocks.h5", EXPECTED)


def test_other_settings(chain: dict[Path, str], tmp_path: Path) -> None:
    expected = {**EXPECTED, "deflections": settings_digest({"b": 3})}
    problem = "made with other settings or an older version of its stage"
    assert _problems(chain, expected) == [("deflections", problem)]
    with pytest.raises(ArtifactError, match=r"deflections\.h5: made with other settings"):
        check_chain(tmp_path / "mocks.h5", expected)


def test_truncated(chain: dict[Path, str], tmp_path: Path) -> None:
    path = tmp_path / "mocks.h5"
    path.write_bytes(path.read_bytes()[:1000])
    ((name, problem),) = _problems(chain)
    assert name == "mocks"
    assert problem.startswith("damaged: ")
