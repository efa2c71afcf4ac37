"""Links, paths, modules and keys that the documents name exist; the index names all documents."""

from __future__ import annotations

import re
from pathlib import Path
from pkgutil import resolve_name

import pytest

from warmlens.config.reference import keys

ROOT = Path(__file__).parents[2]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


def without_code(text: str) -> str:
    """The text without fenced blocks and code in backticks."""
    return re.sub(r"`[^`\n]*`", "", re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL))


def anchors(text: str) -> set[str]:
    """Names of the headings as links write them."""
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def broken(document: Path, text: str) -> list[str]:
    """Relative links that lead nowhere."""
    wrong = []
    for link in LINK.findall(without_code(text)):
        if "://" in link or link.startswith("mailto:"):
            continue
        name, _, anchor = link.partition("#")
        target = document.parent / name if name else document
        if not target.exists() or (anchor and anchor not in anchors(target.read_text())):
            wrong.append(link)
    return wrong


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(document: Path) -> None:
    assert broken(document, document.read_text()) == []


def test_a_broken_link_is_found() -> None:
    text = "[a](scan.md) [b](absent.md) [c](scan.md#symbols-one-band) [d](scan.md#nothing) `[e](absent.md)`"
    assert broken(ROOT / "docs/index.md", text) == ["absent.md", "scan.md#nothing"]


def test_the_index_names_every_document() -> None:
    named = set(LINK.findall((ROOT / "docs/index.md").read_text()))
    assert {path.name for path in DOCUMENTS[1:]} - {"index.md"} <= named


def test_files_that_the_documents_name_exist() -> None:
    """Paths in backticks: below the folders of the repository, and modules below the package."""
    for document in DOCUMENTS:
        text = document.read_text()
        for path in re.findall(r"`((?:src|tests|workflow|docs|benchmarks)/[\w./-]+\w)`", text):
            assert (ROOT / path).exists(), f"{document.name} names {path}"
        for path in re.findall(r"`((?!src|tests|workflow|docs|benchmarks)\w+/[\w/]+\.py)`", text):
            assert (ROOT / "src/warmlens" / path).exists(), f"{document.name} names {path}"


def test_modules_that_the_documents_name_exist() -> None:
    for document in DOCUMENTS:
        for name in re.findall(r"(?<![\w/.-])warmlens(?:\.[a-z_]\w*)+", document.read_text()):
            if name != "warmlens.yaml":
                resolve_name(name)  # raises if there is none


def test_keys_of_the_decisions_exist() -> None:
    """Last cells of the tables: each key in backticks is a key of config.yaml or a block of keys."""
    known = {".".join(key.path[:n]) for key in keys() for n in range(1, len(key.path) + 1)}
    rows = re.findall(r"^\|.*\|([^|]*)\|$", (ROOT / "docs/decisions.md").read_text(), re.MULTILINE)
    named = [name.partition(":")[0] for row in rows for name in re.findall(r"`([^`]+)`", row)]
    assert len(named) > 50
    assert [name for name in named if name not in known and not name.startswith("warmlens ")] == []
