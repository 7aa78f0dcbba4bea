"""How the ray caster's kernels are compiled and kept."""

from __future__ import annotations

import functools
import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path

import numba

_CACHE = "kernels-"  # folders of machine code in __pycache__, one per state of these sources


@functools.cache
def _folder() -> Path:
    """Cache folder of machine code, named by the content of all files here.

    numba checks only the file of a function, and would keep code whose constants or callees changed in another file.
    """
    here = Path(__file__).parent
    state = hashlib.blake2b(b"".join(path.read_bytes() for path in sorted(here.glob("*.py"))), digest_size=8)
    folder = here / "__pycache__" / (_CACHE + state.hexdigest())
    if not folder.exists():
        for old in folder.parent.glob(_CACHE + "*"):
            shutil.rmtree(old, ignore_errors=True)
    return folder


def kernel(parallel: bool = False, inline: str = "never") -> Callable:
    """Compile a function at its first call; later processes load it from disk.

    If this folder is not writable, numba uses the user's cache.
    """

    def compiled(function: Callable) -> Callable:
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(_folder())
        try:
            return numba.njit(cache=True, parallel=parallel, inline=inline)(function)
        finally:
            numba.config.CACHE_DIR = before

    return compiled
