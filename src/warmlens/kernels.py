"""`njit` of numba, and its cache of compiled kernels made to survive: a damaged or full one only costs time.

numba raises whatever goes wrong there from the call of the kernel, as if the sample were at fault. This holds for
all kernels of a process, also those of lenstronomy.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from typing import Any

from numba import njit
from numba.core import caching

from warmlens import runtime

__all__ = ["njit"]

log = logging.getLogger(__name__)
_load, _save = caching.Cache.load_overload, caching.Cache.save_overload


def _load_or_compile(cache: Any, *arguments: Any) -> Any:
    """Load a kernel; None, for which numba compiles it, if what is stored is no kernel."""
    try:
        return _load(cache, *arguments)
    except Exception as error:  # unpickling of a damaged file may raise anything
        _say("damaged; it is removed, and the kernel compiled again", cache, error)
        with contextlib.suppress(OSError):
            cache.flush()
        return None


def _save_if_possible(cache: Any, *arguments: Any) -> None:
    """Store a kernel, if there is room for it."""
    try:
        _save(cache, *arguments)
    except Exception as error:
        _say("not stored; the next process compiles it again", cache, error)


def _say(what: str, cache: Any, error: Exception) -> None:
    log.warning("compiled kernel in %s: %s (%s: %s)", cache.cache_path, what, type(error).__name__, error)


def _install(name: str, method: Callable[..., Any]) -> None:
    setattr(caching.Cache, name, method)


_install("load_overload", _load_or_compile)
_install("save_overload", _save_if_possible)
if reason := runtime.lost_cache():
    log.warning("%s", reason)
