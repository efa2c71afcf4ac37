"""The cache of compiled kernels: what is damaged or cannot be stored is compiled again."""

from __future__ import annotations

import errno
import importlib.util
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numba
import pytest
from numba.core import caching

from .reliability import Outcome, fault

SOURCE = "from warmlens.kernels import njit\n@njit(cache=True)\ndef plus_one(x):\n    return x + 1.0\n"


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[], ModuleType]:
    """Import a module with a kernel, as another process would."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "kernel.py").write_text(SOURCE)

    def imported() -> ModuleType:
        spec = importlib.util.spec_from_file_location("kernel", tmp_path / "kernel.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return imported


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


DAMAGES: dict[str, Callable[[Path], object]] = {
    "emptied": lambda path: path.write_bytes(b""),
    "cut short": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "zeros": lambda path: path.write_bytes(bytes(path.stat().st_size)),
    "garbage": lambda path: path.write_bytes(b"garbage."),
    "a folder": _folder,
}


@fault(
    "Machine",
    "the cache of compiled kernels is damaged",
    "index or code emptied, cut short, zeros, garbage",
    quick=True,
)
@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged(
    load: Callable[[], ModuleType],
    tmp_path: Path,
    suffix: str,
    damage: str,
    caplog: pytest.LogCaptureFixture,
    outcome: Outcome,
) -> None:
    assert load().plus_one(1.0) == 2.0
    assert not caplog.messages
    (path,) = (tmp_path / "cache").rglob(f"*{suffix}")
    DAMAGES[damage](path)
    assert load().plus_one(1.0) == 2.0
    if damage != "a folder":
        assert "damaged; it is removed, and the kernel compiled again" in caplog.text
        again = load()
        assert again.plus_one(1.0) == 2.0
        assert sum(again.plus_one.stats.cache_hits.values()) == 1, "stored anew"
    outcome.goes_on("removed and compiled again, with a warning", "nothing")


@fault(
    "Machine",
    "the disk is full when a kernel has been compiled",
    "ENOSPC, EDQUOT, EROFS while it is stored",
    quick=True,
)
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS])
def test_no_room(
    load: Callable[[], ModuleType],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    outcome: Outcome,
    number: int,
) -> None:
    def full(*_: object) -> None:
        raise OSError(number, "no")

    monkeypatch.setattr(caching.IndexDataCacheFile, "_save_data", full)
    assert load().plus_one(1.0) == 2.0
    assert "not stored; the next process compiles it again" in caplog.text
    outcome.goes_on("used, not stored, with a warning", "nothing")
