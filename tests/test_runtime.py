"""The environment of a process: threads, folders of kernels, encodings; whatever the user has set."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from warmlens import runtime

from .reliability import Outcome, fault

KERNEL = b"from warmlens.lensing.constants import A\n@njit(cache=True)\ndef f(): return A"


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, str]:
    """An environment that a test may change, with a home of its own."""
    variables = {"HOME": str(tmp_path / "home")}
    monkeypatch.setattr(os, "environ", variables)
    return variables


@fault("Machine", "threads, locks and a display of the user", "variables of the environment set", quick=True)
def test_what_numbers_depend_on_is_forced(environment: dict[str, str], outcome: Outcome) -> None:
    environment |= {"OMP_NUM_THREADS": "4", "OPENBLAS_NUM_THREADS": "8", "MPLBACKEND": "module://notebook"}
    environment |= {"HDF5_USE_FILE_LOCKING": "TRUE", "NUMBA_CACHE_LOCATOR_CLASSES": "InTreeCacheLocator"}
    runtime.prepare()
    assert {environment[f"{name}_NUM_THREADS"] for name in ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMBA")} == {"1"}
    assert environment["VECLIB_MAXIMUM_THREADS"] == "1"
    assert environment["MPLBACKEND"] == "agg"
    assert environment["HDF5_USE_FILE_LOCKING"] == "FALSE"
    assert "NUMBA_CACHE_LOCATOR_CLASSES" not in environment
    outcome.goes_on("one thread, no lock, no display, whatever is set", "nothing")


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({"XDG_CACHE_HOME": "/tmp/x/cache"}, "/tmp/x/cache/warmlens"),
        ({"XDG_CACHE_HOME": ""}, "HOME/.cache/warmlens"),
        ({"XDG_CACHE_HOME": "not/absolute"}, "HOME/.cache/warmlens"),
        ({"NUMBA_CACHE_DIR": "/tmp/x/numba", "XDG_CACHE_HOME": "/tmp/x/cache"}, "/tmp/x/numba"),
    ],
)
def test_where_kernels_are_kept(environment: dict[str, str], variables: dict[str, str], expected: str) -> None:
    environment |= variables
    for digest in ("a", "a", "b", "a"):  # child processes inherit the variable, also those of other code
        folder = runtime.kernel_folder(digest)
        assert str(folder) == f"{expected.replace('HOME', environment['HOME'])}/kernels-{digest}"
        assert folder.is_dir()
        environment["NUMBA_CACHE_DIR"] = str(folder)


@pytest.mark.parametrize("home", ["a file", "none"])
@fault("Machine", "no folder for compiled kernels can be written", "a home that is none, or not there", quick=True)
def test_a_home_that_cannot_be_written(
    environment: dict[str, str], tmp_path: Path, home: str, monkeypatch: pytest.MonkeyPatch, outcome: Outcome
) -> None:
    if home == "none":

        def no_home() -> Path:
            raise RuntimeError("Could not determine home directory.")

        monkeypatch.setattr(Path, "home", no_home)
    else:
        (tmp_path / "home").write_text("")
    folder = runtime.kernel_folder("a")
    assert folder.is_dir() and folder.name == "kernels-a"
    assert str(folder.parents[1]) == environment["XDG_CACHE_HOME"], "for Snakemake and matplotlib too"
    assert "set XDG_CACHE_HOME to a folder" in runtime.lost_cache()
    assert runtime.lost_cache() == "", "it is reported once"
    outcome.goes_on("compiled for that process, with a warning", "nothing")


def test_a_folder_of_the_user_that_cannot_be_written(environment: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("")
    environment["NUMBA_CACHE_DIR"] = str(tmp_path / "mine")
    assert runtime.kernel_folder("a") == tmp_path / "home/.cache/warmlens/kernels-a"
    assert f"not kept in {tmp_path}/mine, which cannot be written" in runtime.lost_cache()


def test_nowhere_to_write_is_one_line(environment: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "home").write_text("")

    def nowhere(prefix: str) -> str:
        raise FileNotFoundError(2, "No usable temporary directory found in ['/tmp']")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runtime.tempfile, "mkdtemp", nowhere)
        with pytest.raises(SystemExit, match=r"No usable temporary directory .*; set TMPDIR to a folder"):
            runtime.kernel_folder("a")


@fault(
    "Machine",
    "a kernel or constant that a kernel of another file uses is changed",
    "NUMBA_CACHE_DIR set",
    quick=True,
)
def test_code_that_was_compiled_from_other_sources_is_never_loaded(
    monkeypatch: pytest.MonkeyPatch, environment: dict[str, str], tmp_path: Path, outcome: Outcome
) -> None:
    monkeypatch.setattr(runtime, "__file__", str(tmp_path / "warmlens/runtime.py"))
    environment["NUMBA_CACHE_DIR"] = str(tmp_path / "cache")
    (tmp_path / "warmlens/scan").mkdir(parents=True)
    (tmp_path / "warmlens/lensing").mkdir()
    kernel, constants, plain = (
        tmp_path / "warmlens" / name for name in ("scan/maps.py", "lensing/constants.py", "scan/plain.py")
    )
    kernel.write_bytes(KERNEL)
    constants.write_text("A = 1\n")
    plain.write_text("x = 2\n")
    folders = [_folder(environment)]
    plain.write_text("x = 3\n")
    assert _folder(environment) == folders[0], "what no kernel uses"
    constants.write_text("A = 2\n")
    folders.append(_folder(environment))
    kernel.write_bytes(KERNEL + b" + 1")
    folders.append(_folder(environment))
    environment["NUMBA_OPT"] = "0"
    folders.append(_folder(environment))
    monkeypatch.setattr(runtime, "version", lambda name: "99")
    folders.append(_folder(environment))
    assert len(set(folders)) == 5
    assert {folder.parent for folder in folders} == {tmp_path / "cache"}
    outcome.goes_on("compiled again: its folder is named after all that it uses", "nothing")


def _folder(environment: dict[str, str]) -> Path:
    runtime.prepare()
    return Path(environment["NUMBA_CACHE_DIR"])


def test_machine_names_processor_and_blas() -> None:
    import numpy  # noqa: F401 (whose BLAS is named)

    words = runtime.machine.__wrapped__()
    assert os.uname().machine in words and ";" in words
    assert os.uname().nodename not in words


@fault(
    "Machine",
    "a terminal and a locale that are not UTF-8",
    "LC_ALL, PYTHONIOENCODING; a text with ≥ and ☉",
    quick=True,
)
@pytest.mark.parametrize(
    "variables",
    [
        {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"},
        {"LC_ALL": "POSIX", "PYTHONIOENCODING": "latin-1"},
        {"PYTHONIOENCODING": "ascii:strict", "PYTHONUTF8": "0"},
    ],
)
def test_other_encodings(tmp_path: Path, variables: dict[str, str], outcome: Outcome) -> None:
    (tmp_path / "overlay.yaml").write_text("results: results/é☉\n", encoding="utf-8")
    command = [
        str(Path(sys.executable).parent / "warmlens"),
        "validate",
        "--configfile",
        "workflow/configs/ci.yaml",
    ]
    root, env = Path(__file__).parents[1], {**os.environ, **variables}
    command += ["--configfile", str(tmp_path / "overlay.yaml")]
    done = subprocess.run(command, cwd=root, env=env, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    shown = done.stdout.rstrip().rpartition(b"results/")[2]
    assert shown in (b"\xe9\\u2609", b"\\xe9\\u2609", "é☉".encode())
    outcome.goes_on("what the terminal lacks is spelled out", "nothing")
