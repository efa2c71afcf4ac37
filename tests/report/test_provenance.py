from __future__ import annotations

from pathlib import Path

import pytest

from warmlens.artifacts.file import Header
from warmlens.report.campaign_page import file_warnings
from warmlens.report.provenance import CampaignProvenance, peak_memory

HEAD = "s\th:m:s\tmax_rss\tcpu_time\n"


def test_peak_memory_is_the_largest_of_all_files_of_a_stage(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    (tmp_path / "null").mkdir()
    (tmp_path / "scans/0000000-0000007.tsv").write_text(f"{HEAD}3.1\t0:00:03\t313.07\t2.9\n")
    (tmp_path / "scans/0000007-0000014.tsv").write_text(f"{HEAD}3.1\t0:00:03\t470.5\t2.9\n3\t0:00:03\t9.0\t2\n")
    (tmp_path / "scan_design.tsv").write_text(f"{HEAD}0.1\t0:00:00\tNA\t0.0\n")
    (tmp_path / "null/scans.tsv").write_text(f"{HEAD}1\t0:00:01\t88\t1\n")
    assert peak_memory(tmp_path, "scans") == 470.5
    assert peak_memory(tmp_path, "null_scans") == 88.0
    assert peak_memory(tmp_path, "scan_design") is None, "not measured"
    assert peak_memory(tmp_path, "abc") is None, "no file"


def _header(stage: str, commit: str, dirty: bool) -> Header:
    return Header(
        path=Path(f"{stage}.h5"),
        stage=stage,
        schema=f"warmlens/{stage}",
        schema_version=2,
        digest="d",
        settings={},
        inputs={},
        seed_key="",
        span=None,
        package_version="0.1.0",
        git_commit=commit,
        git_dirty=dirty,
        code_sha256="",
        created_utc="2026-01-01T00:00:00+00:00",
        wall_seconds=1.0,
    )


def _provenance(*headers: Header, missing: tuple[str, ...] = (), problem: str = "") -> CampaignProvenance:
    return CampaignProvenance({f"{i}.h5": header for i, header in enumerate(headers)}, missing, problem, [])


def test_what_is_wrong_with_the_files_is_listed() -> None:
    assert file_warnings(_provenance(_header("halos", "a", False), _header("abc", "a", False))) == []
    headers = (_header("halos", "a", True), _header("mocks", "b", False), _header("abc", "b", True))
    missing = tuple(f"mocks/{i}.h5" for i in range(6))
    assert file_warnings(
        _provenance(*headers, missing=missing, problem="abc.h5: its input has changed since")
    ) == [
        "the chain of artifacts is broken: abc.h5: its input has changed since",
        "6 artifacts of the campaign are no longer there: mocks/0.h5, mocks/1.h5, mocks/2.h5, mocks/3.h5 and 2 "
        "more",
        "made by code with changes that were not committed: halos, abc",
        "the artifacts were made by 2 commits of the code",
    ]


@pytest.mark.parametrize("commits", [("a",), ("b", "a", "b")])
def test_commits_are_counted_once(commits: tuple[str, ...]) -> None:
    provenance = _provenance(*(_header("halos", commit, False) for commit in commits))
    assert provenance.commits == tuple(sorted(set(commits)))
