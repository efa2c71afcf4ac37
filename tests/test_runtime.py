from __future__ import annotations

import os
from pathlib import Path

import pytest

from warmlens import runtime


def test_defaults_and_what_the_user_has_set(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(os, "environ", {"OMP_NUM_THREADS": "4", "XDG_CACHE_HOME": str(tmp_path)})
    runtime.prepare()
    assert os.environ["OMP_NUM_THREADS"] == "4"
    assert os.environ["OPENBLAS_NUM_THREADS"] == "1"
    assert os.environ["NUMBA_CACHE_DIR"] == str(tmp_path / "warmlens" / runtime.kernel_digest()[:16])


def test_digest_changes_with_any_kernel(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(runtime, "__file__", str(tmp_path / "runtime.py"))
    (tmp_path / "scan").mkdir()
    (tmp_path / "scan/maps.py").write_text("@njit\ndef f(): return 1\n")
    before = runtime.kernel_digest()
    (tmp_path / "scan/plain.py").write_text("x = 2\n")
    assert runtime.kernel_digest() == before
    (tmp_path / "scan/maps.py").write_text("@njit\ndef f(): return 2\n")
    assert runtime.kernel_digest() != before
