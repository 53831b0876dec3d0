"""numba's ``njit`` for systems that refuse it a cache: compiled functions are kept where that is possible, and work where not.

An installation that its user cannot write, without a home directory, has no place for numba's cache (numba issue 5566); a full
disk or a damaged file in the cache is no reason to fail either. Compiling anew takes half a minute per process, and gives the
same bits.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numba

_said: set[str] = set()


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit`` with these options, of which ``cache`` is a wish."""

    def compile_later(function: Callable[..., Any]) -> Any:
        try:
            dispatcher = numba.njit(**options)(function)
        except RuntimeError as error:
            if not options.get("cache") or "cannot cache" not in str(error):
                raise
            _say_once("there is no place for compiled functions (set NUMBA_CACHE_DIR to a folder that you can write)")
            return numba.njit(**{**options, "cache": False})(function)
        cache: Any = getattr(dispatcher, "_cache", None)
        if hasattr(cache, "_guard_against_spurious_io_errors"):
            cache._guard_against_spurious_io_errors = _without_cache  # numba asks it around every access to the cache
        return dispatcher

    return compile_later


@contextlib.contextmanager
def _without_cache() -> Iterator[None]:
    try:
        yield
    except Exception as error:  # a damaged file can raise nearly anything when it is unpickled
        reason = " ".join(str(error).split())[:120]
        _say_once(f"numba's cache cannot be used ({type(error).__name__}: {reason}); clear it, or make room")


def _say_once(what: str) -> None:
    if what not in _said and multiprocessing.parent_process() is None:  # or each worker would repeat it
        _said.add(what)
        warnings.warn(f"{what}; functions are compiled anew in each process", stacklevel=1)
