"""What must be set before the numerical libraries are imported, and the machine that numbers depend on."""

from __future__ import annotations

import atexit
import hashlib
import os
import platform
import re
import shutil
import sys
import tempfile
from functools import cache
from importlib.metadata import version
from pathlib import Path

# The order of a sum depends on the number of threads, and with it the last digits: whatever the user has set.
_THREADS = ("OMP", "OPENBLAS", "MKL", "BLIS", "VECLIB", "NUMEXPR", "NUMBA")
_FORCED = {
    **{f"{name}_NUM_THREADS": "1" for name in _THREADS if name != "VECLIB"},
    "VECLIB_MAXIMUM_THREADS": "1",
    "HDF5_USE_FILE_LOCKING": "FALSE",  # files are renamed in place; network disks may have no locks
    "MPLBACKEND": "agg",  # that of a notebook is not there in a job
    "PYTHONUTF8": "1",  # for child processes
}
_COMPILERS = ("numba", "llvmlite", "numpy", "lenstronomy")  # lenstronomy has kernels of its own
_FOLDER = "kernels-"
_IMPORTED = re.compile(rb"^from warmlens\.([\w.]+) import", re.MULTILINE)
_lost_cache: list[str] = []  # why there is none


def prepare() -> None:
    """Set one thread per process, no locks, no display, and a cache of compiled kernels for exactly this code.

    Parallelism is over jobs, and results do not depend on the number of cores. Child processes inherit all this.
    """
    os.environ |= _FORCED
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    os.environ["PYTHONIOENCODING"] = f"{encoding}:backslashreplace"  # of child processes, Snakemake's included
    os.environ.pop("NUMBA_CACHE_LOCATOR_CLASSES", None)  # numba would pass over the folder
    os.environ["NUMBA_CACHE_DIR"] = str(kernel_folder(kernel_digest()[:16]))


def kernel_folder(digest: str) -> Path:
    """Make the folder for compiled kernels and return it: below the user's choice, named after the digest.

    Where no cache can be written there is a temporary one, until this process ends, for Snakemake and matplotlib
    too. numba would fall back on the folder of the sources, and find code there that was compiled with other
    versions of the kernels that it calls.
    """
    name = f"{_FOLDER}{digest}"
    home = _cache_home()
    chosen = Path(os.environ.get("NUMBA_CACHE_DIR") or home).absolute()
    if chosen.name.startswith(_FOLDER):  # of a parent process
        chosen = chosen.parent
    try:
        return _made(chosen / name)
    except OSError as error:
        _lost_cache.append(f"compiled kernels are not kept in {chosen}, which cannot be written ({error})")
        return _made(home / name)


def _cache_home() -> Path:
    """Return the folder of this program in the user's cache, or in a temporary one if that cannot be written."""
    chosen = os.environ.get("XDG_CACHE_HOME", "")
    try:
        caches = Path(chosen) if os.path.isabs(chosen) else Path.home() / ".cache"  # noqa: PTH117 (as XDG says)
        return _made(caches / "warmlens")
    except (OSError, RuntimeError) as error:  # RuntimeError: there is no home
        try:
            temporary = Path(tempfile.mkdtemp(prefix="warmlens-"))
        except OSError as nowhere:
            sys.exit(f"warmlens: {nowhere}; set TMPDIR to a folder that can be written")
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        _lost_cache.append(
            f"no cache can be written ({error}); set XDG_CACHE_HOME to a folder for compiled kernels"
        )
        os.environ["XDG_CACHE_HOME"] = str(temporary)
        return _made(temporary / "warmlens")


def _made(folder: Path) -> Path:
    """Make a folder and return it; raise `OSError` if it cannot be written."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder) as probe:
        probe.write(b"room for a kernel?")
    return folder


def lost_cache() -> str:
    """Return why compiled kernels are not kept beyond this process, and what to do, once; "" if they are."""
    return _lost_cache.pop() if _lost_cache else ""


def kernel_digest() -> str:
    """Return the SHA-256 of all that compiled kernels depend on, but the processor, which numba knows.

    When numba reuses compiled code, it checks the file of a kernel, but neither the kernels and constants of other
    files that it uses nor the versions of its own libraries.
    """
    root = Path(__file__).parent
    sha = hashlib.sha256("".join(f"{name} {version(name)}\0" for name in _COMPILERS).encode())
    options = {key: value for key, value in os.environ.items() if key.startswith("NUMBA_")}
    for key in sorted(options.keys() - {"NUMBA_CACHE_DIR", "NUMBA_NUM_THREADS"}):
        sha.update(f"{key}={options[key]}\0".encode(errors="surrogateescape"))
    contents = {path: path.read_bytes() for path in root.rglob("*.py")}
    pending = [path for path, content in contents.items() if b"@njit" in content]
    used: set[Path] = set()
    while pending:
        path = pending.pop()
        if path in contents and path not in used:
            used.add(path)
            modules = _IMPORTED.findall(contents[path])
            pending += [root.joinpath(*module.decode().split(".")).with_suffix(".py") for module in modules]
    for path in sorted(used):
        sha.update(str(path.relative_to(root)).encode() + b"\0" + contents[path])
    return sha.hexdigest()


@cache
def machine() -> str:
    """Return the processor and the BLAS kernels of this process: on others numbers differ by rounding."""
    from threadpoolctl import threadpool_info  # after the libraries, which it looks at

    names = ("internal_api", "version", "architecture")
    loaded = [each for each in threadpool_info() if each["user_api"] == "blas"]
    blas = {" ".join(str(each[name]) for name in names if each.get(name)) for each in loaded}
    return "; ".join([_processor(), *sorted(blas)])


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return " ".join(filter(None, [platform.machine(), models[0] if models else platform.processor()]))
