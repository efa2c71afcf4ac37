"""Faults: a test says in words what it injects and what it saw; docs/reliability.md lists the words.

    @fault("Processes", "a job is killed", "SIGKILL to a stage at work")
    def test_killed_job(project: Project, outcome: Outcome) -> None:
        ...
        outcome.same_digests(project.digests(), finished.digests(), lost="the job in flight")

Words are texts, or names of texts in the same file. The methods of the fixture `outcome` check a result and record
it for the document; tests assert everything else as usual. Tests with the same words share a row.

Without `quick=True` a test is skipped unless `WARMLENS_TEST_FAULTS=1` (`make reliability`) is set. This also
writes the rows of all faults that ran to the document. Other rows stay, so that those of tests/slurm can be
written where there is a Slurm.
"""

from __future__ import annotations

import ast
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCUMENT = ROOT / "docs/reliability.md"
GROUPS = ("Processes", "Slurm", "Disk", "Artifacts", "Origin", "Answers", "Images", "Samples", "Machine")
SAME = "same digests"
STOPS = "stops"
NOTHING = "nothing"
UNPROVEN = "lost or falsified: its test failed"
_HEAD = "| fault | injected how | result | data lost |"
_ASKED = "WARMLENS_TEST_FAULTS"


@dataclass(frozen=True)
class Fault:
    """Words of a fault: its table, what it is, how it is injected."""

    group: str
    what: str
    how: str


@dataclass
class Outcome:
    """What a test saw of its fault."""

    seen: list[tuple[str, str]] = field(default_factory=list)  # result and data lost

    def same_digests(
        self, found: Mapping[str, str], expected: Mapping[str, str], lost: str = NOTHING, after: str = ""
    ) -> None:
        """Record that the campaign ended with the artifacts of an undisturbed one, after the action `after`."""
        assert found == expected
        self.remember(f"{after}: {SAME}" if after else SAME, lost)

    def stops(self, said: str, *words: str, lost: str = NOTHING) -> None:
        """Record that the program refused to go on: `said` has all `words`, the first of which is for the row."""
        text = " ".join(said.split())
        for word in words:
            assert word in text, f"expected {word!r} in:\n{said}"
        self.remember(f"{STOPS}: “{words[0]}”", lost)

    def goes_on(self, result: str, lost: str) -> None:
        """Record that the campaign ended correctly, but not as an undisturbed one: `result` describes how."""
        self.remember(result, lost)

    def remember(self, result: str, lost: str) -> None:
        """Add what was seen, once."""
        if (result, lost) not in self.seen:
            self.seen.append((result, lost))

    @property
    def row(self) -> tuple[str, str]:
        """Result and data lost of all tests that share a row."""
        results, lost = (dict.fromkeys(column) for column in zip(*self.seen, strict=True))
        return "; ".join(results), "; ".join(lost)


def fault(group: str, what: str, how: str, *, quick: bool = False) -> pytest.MarkDecorator:
    """Mark a test of a fault; with `quick` it always runs."""
    assert group in GROUPS, f"{group}: no table of that name, there are {GROUPS}"
    return pytest.mark.fault(group, what, how, quick=quick)


@pytest.fixture
def outcome(request: pytest.FixtureRequest) -> Iterator[Outcome]:
    """Record of what a test of a fault saw."""
    record = Outcome()
    yield record
    request.node.user_properties.append(("outcome", record.seen))


class Recorder:
    """Pytest plugin: skip long tests unless asked for, and write what the tests saw to the document."""

    def __init__(self) -> None:
        self._seen: dict[Fault, Outcome] = {}

    @property
    def _asked(self) -> bool:
        return os.environ.get(_ASKED) == "1"

    def pytest_configure(self, config: pytest.Config) -> None:
        config.addinivalue_line("markers", "fault(group, what, how, quick): test of a fault, see reliability.py")

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        for item in items:
            marker = item.get_closest_marker("fault")
            if marker is None:
                continue
            item.user_properties.append(("fault", marker.args))  # goes with the reports, also between processes
            if not self._asked and not marker.kwargs["quick"]:
                item.add_marker(pytest.mark.skip(reason=f"takes long; {_ASKED}=1 or `make reliability` runs it"))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        properties = dict(report.user_properties)
        if "fault" not in properties or report.skipped:
            return
        whole = self._seen.setdefault(Fault(*properties["fault"]), Outcome())
        if report.failed:
            whole.remember(UNPROVEN, "unknown")
        for result, lost in properties.get("outcome", ()):
            whole.remember(result, lost)

    def pytest_sessionfinish(self) -> None:
        if self._asked and self._seen:
            DOCUMENT.write_text(with_rows(DOCUMENT.read_text(), self._seen))


def declared() -> list[Fault]:
    """Return all faults that the tests of the repository declare, also those that cannot run here."""
    faults: dict[Fault, None] = {}
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        tree = ast.parse(path.read_text())
        texts = {
            target.id: node.value.value
            for node in tree.body
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
            for target in node.targets
            if isinstance(target, ast.Name)
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "fault":
                words = (texts[arg.id] if isinstance(arg, ast.Name) else arg.value for arg in node.args)
                faults[Fault(*words)] = None
    return list(faults)


def read_rows(text: str) -> dict[Fault, tuple[str, str]]:
    """Return result and data lost of every fault in the document."""
    rows: dict[Fault, tuple[str, str]] = {}
    group = ""
    for line in text.splitlines():
        if line.startswith("## "):
            group = line.removeprefix("## ")
        elif line.startswith("| ") and line != _HEAD and not line.startswith("| ---"):
            what, how, result, lost = (cell.strip() for cell in line.strip("|").split(" | "))
            rows[Fault(group, what, how)] = (result, lost)
    return rows


def with_rows(text: str, seen: Mapping[Fault, Outcome]) -> str:
    """Replace or add the rows of `seen` in the document, and remove those of no declared fault."""
    faults = declared()
    rows = {words: row for words, row in read_rows(text).items() if words in faults}
    rows |= {words: outcome.row for words, outcome in seen.items() if outcome.seen}
    introduction, _, _ = text.partition("\n## ")
    parts = [introduction.rstrip() + "\n"]
    for group in GROUPS:
        lines = [
            f"| {words.what} | {words.how} | {' | '.join(rows[words])} |"
            for words in faults
            if words.group == group and words in rows
        ]
        if lines:
            parts.append("\n".join([f"## {group}\n", _HEAD, "| --- | --- | --- | --- |", *lines]) + "\n")
    return "\n".join(parts)
