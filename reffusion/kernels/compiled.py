"""Compiles kernels, caches machine code, and runs kernels on several threads."""

from __future__ import annotations

import functools
import hashlib
import math
import os
import shutil
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numba
import numpy as np
import torch

T = TypeVar("T")
R = TypeVar("R")
_MIN_KEPT, _MAX_BLOCKS = 2**16, 24  # numbers of an array that is reused; arrays kept, about those of two steps
MIN_PARALLEL = 8000  # Gaussians below which another thread costs more time than it saves
# Rounding may vary, but NaN and infinity are preserved, because `fit` checks for them.
FREE_ROUNDING = "contract", "reassoc", "nsz", "arcp"
_PACKAGES = "kernels", "splat", "gaussians", "depth", "background", "inpaint/patchmatch"  # packages with kernels
_torch_threads = threading.local()  # thread-local, like the number itself: torch's number outside `torch_on_one_thread`
_CACHE = "splat-"  # prefix of folders of machine code in __pycache__, one per state of the sources


@functools.cache
def _cache_folder() -> Path:
    """The folder of machine code for the present content of `_PACKAGES`.

    numba itself checks only the file of a function, and would keep using a constant or a callee that changed elsewhere.
    """
    library = Path(__file__).parents[1]
    sources = [path for package in _PACKAGES for path in sorted((library / package).glob("*.py"))]
    digest = hashlib.blake2b(b"".join(path.read_bytes() for path in sources), digest_size=8).hexdigest()
    return Path(__file__).parent / "__pycache__" / (_CACHE + digest)


def kernel(function: Callable, fastmath: tuple[str, ...] = ()) -> Callable:
    """Compile `function` at its first call, to run without the GIL; later processes load it from disk."""
    folder, before = _cache_folder(), numba.config.CACHE_DIR
    try:
        if not folder.exists():
            for old in folder.parent.glob(_CACHE + "*"):
                shutil.rmtree(old, ignore_errors=True)
            folder.mkdir(parents=True, exist_ok=True)
        numba.config.CACHE_DIR = str(folder)
    except OSError:
        pass  # not writable: numba falls back to the user's cache folder
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=set(fastmath))(function)
    finally:
        numba.config.CACHE_DIR = before


def inlined(function: Callable) -> Callable:
    """Inline `function` into every kernel that calls it."""
    return numba.njit(forceinline=True, error_model="numpy")(function)


def empty_aligned(*shape: int) -> np.ndarray:
    """Uninitialised float32 array, aligned to cache lines; large ones reuse memory of arrays that no longer exist.

    Otherwise the system provides new pages for large arrays each time, and clearing these takes much of an
    optimisation step.
    """
    size = math.prod(shape)
    if size < _MIN_KEPT:
        return _cache_aligned(size).reshape(shape)
    blocks, lock = _blocks()
    with lock:
        fits = (block for block in blocks if size <= block.memory.size <= 2 * size and block.tenant() is None)
        block = next(fits, None) or _Block(_cache_aligned(size))
        others = [other for other in blocks if other is not block]
        blocks[:] = [*others[1 - _MAX_BLOCKS :], block]
        # through a memoryview, so that views refer to this array and not to the block
        array = np.frombuffer(block.memory.data, np.float32, size)
        block.tenant = weakref.ref(array)
        return array.reshape(shape)


def _cache_aligned(size: int) -> np.ndarray:
    memory = np.empty(size + 16, np.float32)
    first = -memory.ctypes.data // 4 % 16
    return memory[first : first + size]


@dataclass
class _Block:
    """Memory, and a reference to the array that uses it."""

    memory: np.ndarray
    tenant: Callable[[], np.ndarray | None] = lambda: None


@functools.cache
def _blocks() -> tuple[list[_Block], threading.Lock]:
    """Blocks given out by `empty_aligned`, the latest last, and their lock."""
    return [], threading.Lock()


def threads() -> int:
    """Number of threads for kernels: that of torch, so that one setting (or OMP_NUM_THREADS) controls both.

    Inside `torch_on_one_thread` it is torch's number outside of it.
    """
    return getattr(_torch_threads, "threads", None) or torch.get_num_threads()


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Let torch use one thread, for work that mostly renders; context manager and decorator.

    The operations of torch between kernels are small: synchronising threads in each takes longer than it saves, and far
    longer if another process occupies a core. Besides, results do not depend on the number of threads.
    """
    outer, torch_threads = getattr(_torch_threads, "threads", None), torch.get_num_threads()
    _torch_threads.threads = outer or torch_threads
    torch.set_num_threads(1)
    try:
        yield
    finally:
        _torch_threads.threads = outer
        torch.set_num_threads(torch_threads)


def parallel_for(function: Callable, *arguments, gaussians: int = MIN_PARALLEL) -> None:
    """Call `function(tickets, *arguments)` on every thread at once; they take tickets until all work is done.

    `tickets` [2] int64: a counter for `vectors.take_ticket`, and the number of threads. What a piece of work writes
    must depend only on its number, so that results are the same for any number of threads.

    Args:
        gaussians: number of Gaussians, where it determines the work; below MIN_PARALLEL only this thread is used.
    """
    helpers = threads() - 1 if gaussians >= MIN_PARALLEL else 0
    tickets = np.array([0, helpers + 1])
    pending = [_pool(os.getpid(), helpers).submit(function, tickets, *arguments) for _ in range(helpers)]
    function(tickets, *arguments)
    for future in pending:
        if not future.cancel():  # a thread that did not start has nothing left to do
            future.result()


def side_by_side(function: Callable[[T], R], items: Iterable[T], most: int = 8) -> Iterator[R]:
    """`function` of each item, in order, with up to `most` items at once, one per thread.

    For work whose array operations release the GIL; torch's threads are divided among the items. If the iteration is
    left early, items that have not begun are cancelled.
    """
    workers = max(1, min(threads(), most))
    threads_each = max(1, threads() // workers)
    with ThreadPoolExecutor(workers, "beside", initializer=torch.set_num_threads, initargs=(threads_each,)) as pool:
        try:
            yield from pool.map(function, items)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


@functools.lru_cache(maxsize=1)
def _pool(process: int, helpers: int) -> ThreadPoolExecutor:
    """A pool of waiting threads; a forked process makes its own."""
    return ThreadPoolExecutor(helpers, thread_name_prefix="splat")
