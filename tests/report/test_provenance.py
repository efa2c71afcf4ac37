from __future__ import annotations

from pathlib import Path

import pytest

from warmlens.report.campaign_page import file_warnings
from warmlens.report.provenance import ArtifactRow, Provenance, peak_memory

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


def _row(stage: str, commit: str, dirty: bool) -> ArtifactRow:
    return ArtifactRow(stage, f"{stage}.h5", "d", "s", commit, dirty, "0.1.0", "2026-01-01T00:00:00+00:00", 1.0)


def test_what_is_wrong_with_the_files_is_said() -> None:
    fine = Provenance((_row("halos", "a", False), _row("abc", "a", False)), (), "", ())
    assert file_warnings(fine) == []
    rows = (_row("halos", "a", True), _row("mocks", "b", False), _row("abc", "b", True))
    bad = Provenance(rows, tuple(f"mocks/{i}.h5" for i in range(6)), "abc.h5: its input has changed since", ())
    said = file_warnings(bad)
    assert said == [
        "the chain of artifacts is broken: abc.h5: its input has changed since",
        "6 artifacts of the campaign are no longer there: mocks/0.h5, mocks/1.h5, mocks/2.h5, mocks/3.h5 and 2 "
        "more",
        "made by code with changes that were not committed: halos, abc",
        "the artifacts were made by 2 commits of the code",
    ]


@pytest.mark.parametrize("commits", [("a",), ("b", "a", "b")])
def test_commits_are_counted_once(commits: tuple[str, ...]) -> None:
    rows = tuple(_row("halos", commit, False) for commit in commits)
    assert Provenance(rows, (), "", ()).commits == tuple(sorted(set(commits)))
