"""The files that install the project agree with one another."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
LOCK = (ROOT / "requirements.lock").read_text().splitlines()
# packages that are named otherwise on conda-forge
CONDA_NAMES = {"matplotlib": "matplotlib-base"}


def _name(requirement: str) -> str:
    match = re.match(r"[A-Za-z0-9_.-]+", requirement)
    assert match
    return re.sub(r"[-_.]+", "-", match.group()).lower()


def _locked() -> dict[str, str]:
    return {_name(line): line.partition("==")[2] for line in LOCK}


def test_lock_holds_exact_pins_and_no_addresses() -> None:
    assert all(re.fullmatch(r"[A-Za-z0-9_.-]+==[A-Za-z0-9_.+!]+", line) for line in LOCK)


def test_text_files_are_utf_8_in_every_locale() -> None:
    """A call that reads or writes text has its encoding."""
    careless = []
    for path in [*(ROOT / "src").rglob("*.py"), *(ROOT / "workflow").rglob("*.smk"), ROOT / "Snakefile"]:
        for call in re.finditer(r"\.(?:read_text|write_text|open)\(", path.read_text(encoding="utf-8")):
            arguments = _arguments(call.string, call.end())
            is_text = "open" not in call[0] or re.match(r'"[rwxa]"|newline|$', arguments)
            if is_text and "encoding=" not in arguments:
                careless.append(f"{path.relative_to(ROOT)}: {call[0]}{arguments})")
    assert not careless


def _arguments(text: str, start: int) -> str:
    depth, end = 1, start
    while depth:
        depth += {"(": 1, ")": -1}.get(text[end], 0)
        end += 1
    return text[start : end - 1]


def test_lock_covers_all_dependencies() -> None:
    extras = PROJECT["optional-dependencies"]
    wanted = {_name(item) for item in PROJECT["dependencies"] + extras["dev"] + extras["slurm"]}
    assert wanted <= set(_locked())


def test_conda_environment_is_in_step() -> None:
    environment = yaml.safe_load((ROOT / "envs/warmlens.yaml").read_text())
    pins = dict(item.split("=") for item in environment["dependencies"] if isinstance(item, str))
    python = pins.pop("python")
    assert python.startswith(PROJECT["requires-python"].removeprefix(">="))
    expected = {CONDA_NAMES.get(name, name): _locked()[name] for name in map(_name, PROJECT["dependencies"])}
    assert pins == expected


def test_readme_commands_are_targets_of_the_makefile() -> None:
    commands = re.findall(r"^ *make (\w+)", (ROOT / "README.md").read_text(), flags=re.MULTILINE)
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
    assert {"demo", "test"} <= set(commands) <= set(targets)
    assert "make test" in (ROOT / ".ci/run").read_text()


def test_citation_names_the_paper_and_the_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == PROJECT["version"]
    assert citation["preferred-citation"]["doi"] == "10.1088/1475-7516/2017/05/037"
