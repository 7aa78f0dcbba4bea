"""Compilation of the ray caster's numba kernels, and their cache on disk."""

from __future__ import annotations

import functools
import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path

import numba

_CACHE = "kernels-"  # beginning of the names of cache folders in __pycache__


@functools.cache
def _folder() -> Path:
    """Return the cache folder of machine code, named by a hash of the Python files here; delete those of old hashes."""
    here = Path(__file__).parent
    # numba checks only the file of a function. Without the hash it would reuse machine code although constants or
    # called functions in other files have changed.
    state = hashlib.blake2b(b"".join(path.read_bytes() for path in sorted(here.glob("*.py"))), digest_size=8)
    folder = here / "__pycache__" / (_CACHE + state.hexdigest())
    if not folder.exists():
        for old in folder.parent.glob(_CACHE + "*"):
            shutil.rmtree(old, ignore_errors=True)
    return folder


def kernel(parallel: bool = False, inline: str = "never") -> Callable:
    """Return a decorator that compiles a function with numba at its first call and caches the machine code on disk.

    Later processes load the machine code from the cache. The cache is in the __pycache__ of this module's folder, or in
    the user's cache of numba if that is not writable.

    Args:
        parallel: True runs `prange` loops in several threads.
        inline: numba's option `inline`, "never" or "always".
    """

    def compiled(function: Callable) -> Callable:
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(_folder())
        try:
            return numba.njit(cache=True, parallel=parallel, inline=inline)(function)
        finally:
            numba.config.CACHE_DIR = before

    return compiled
