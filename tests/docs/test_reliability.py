"""docs/reliability.md has a row for every fault that the tests inject, and none that was lost or falsified."""

from __future__ import annotations

import pytest

from ..reliability import DOCUMENT, NOTHING, SAME, UNPROVEN, Fault, Outcome, declared, read_rows, with_rows


def test_every_fault_has_its_row_and_every_row_its_test() -> None:
    assert sorted(read_rows(DOCUMENT.read_text()), key=str) == sorted(declared(), key=str), (
        "run `make reliability`, as root with WARMLENS_TEST_SLURM=1 if faults of Slurm have changed"
    )


def test_no_row_is_lost_or_falsified() -> None:
    for words, (result, lost) in read_rows(DOCUMENT.read_text()).items():
        assert result and lost, words
        assert "lost or falsified" not in result, words


def test_a_row_is_replaced_and_others_stay() -> None:
    first, second = declared()[:2]
    text = with_rows(
        "# Title\n\nIntroduction.\n", {first: Outcome([(SAME, NOTHING)]), second: Outcome([("x", "y")])}
    )
    assert text.startswith("# Title\n\nIntroduction.\n\n## ")
    assert read_rows(text) == {first: (SAME, NOTHING), second: ("x", "y")}
    gone = Fault("Disk", "a fault", "that no test injects any more")
    both = Outcome([("x", "z"), ("x", "z"), (SAME, "z")])
    again = with_rows(with_rows(text, {gone: Outcome([("x", "y")])}), {second: both})
    assert read_rows(again) == {first: (SAME, NOTHING), second: (f"x; {SAME}", "z")}
    assert with_rows(again, {}) == again


def test_a_failed_test_is_seen() -> None:
    first = declared()[0]
    text = with_rows("# Title\n", {first: Outcome([(UNPROVEN, "unknown")])})
    assert "lost or falsified" in read_rows(text)[first][0]
    outcome = Outcome()
    with pytest.raises(AssertionError):
        outcome.same_digests({"a": "1"}, {"a": "2"})
    with pytest.raises(AssertionError, match="expected 'delete the file'"):
        outcome.stops("something else", "delete the file")
    assert outcome.seen == []
