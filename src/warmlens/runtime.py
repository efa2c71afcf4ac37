"""Environment variables that must be set before the numerical libraries are imported."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def prepare() -> None:
    """Set one thread per process, and a cache of compiled kernels for exactly this source code.

    Parallelism is over jobs, and results do not depend on the number of cores. When numba reuses compiled code, it
    checks the file of a kernel but not the kernels that it calls in other files: one folder per version of the
    kernels prevents the use of a stale one. Child processes inherit the variables; those of the user are kept.
    """
    for variable in _THREADS:
        os.environ.setdefault(variable, "1")
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    os.environ.setdefault("NUMBA_CACHE_DIR", str(cache / "warmlens" / kernel_digest()[:16]))


def kernel_digest() -> str:
    """Return the SHA-256 over the names and contents of all modules of the package that hold compiled kernels."""
    root = Path(__file__).parent
    sha = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        content = path.read_bytes()
        if b"njit" in content:
            sha.update(str(path.relative_to(root)).encode() + b"\0" + content)
    return sha.hexdigest()
