"""How kernels are compiled, kept, and shared out among threads."""

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
_LARGE, _BLOCKS = 2**16, 24  # numbers of an array worth keeping; how many are kept, some two steps' worth
FEW = 8000  # Gaussians for which waking another thread takes longer than it saves
# Rounding may vary, but NaN and infinity stay what they are: `fit` looks for them.
FREE_ROUNDING = "contract", "reassoc", "nsz", "arcp"
_ROOMS = "kernels", "splat", "gaussians", "depth", "texture", "masks"  # the packages that have kernels
_OUTSIDE = threading.local()  # `threads`: torch's number outside of `torch_on_one_thread`, by thread as torch's is
_CACHE = "splat-"  # folders of machine code in __pycache__, one per state of these sources


@functools.cache
def _cache_folder() -> Path:
    """Machine code is kept by the content of all files of `_ROOMS`: numba itself looks only at the one file of a
    function, and would go on using a constant or a callee that has changed elsewhere."""
    library = Path(__file__).parents[1]
    sources = [path for room in _ROOMS for path in sorted((library / room).glob("*.py"))]
    digest = hashlib.blake2b(b"".join(path.read_bytes() for path in sources), digest_size=8).hexdigest()
    return Path(__file__).parent / "__pycache__" / (_CACHE + digest)


def kernel(function: Callable, fastmath: tuple[str, ...] = ()) -> Callable:
    """Compile `function` at its first call, without the interpreter's lock; later processes load it from disk."""
    folder, before = _cache_folder(), numba.config.CACHE_DIR
    try:
        if not folder.exists():
            for old in folder.parent.glob(_CACHE + "*"):
                shutil.rmtree(old, ignore_errors=True)
            folder.mkdir(parents=True, exist_ok=True)
        numba.config.CACHE_DIR = str(folder)
    except OSError:
        pass  # an installation that cannot be written to: numba falls back to the user's cache folder
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=set(fastmath))(function)
    finally:
        numba.config.CACHE_DIR = before


def inlined(function: Callable) -> Callable:
    """Compile `function` as a part of every kernel that calls it."""
    return numba.njit(forceinline=True, error_model="numpy")(function)


def empty_aligned(*shape: int) -> np.ndarray:
    """Uninitialised float32 from a cache line's border on, where possible in memory given out before that nobody holds.

    Arrays of megabytes are otherwise made of fresh pages each time, and clearing those costs a good part of a step.
    """
    size = math.prod(shape)
    if size < _LARGE:
        return _cache_aligned(size).reshape(shape)
    blocks, lock = _blocks()
    with lock:
        fits = (block for block in blocks if size <= block.memory.size <= 2 * size and block.tenant() is None)
        block = next(fits, None) or _Block(_cache_aligned(size))
        others = [other for other in blocks if other is not block]
        blocks[:] = [*others[1 - _BLOCKS :], block]
        # through a memoryview, so that this array, not the block, is what its views refer to
        array = np.frombuffer(memoryview(block.memory), np.float32, size)
        block.tenant = weakref.ref(array)
        return array.reshape(shape)


def _cache_aligned(size: int) -> np.ndarray:
    memory = np.empty(size + 16, np.float32)
    first = -memory.ctypes.data // 4 % 16
    return memory[first : first + size]


@dataclass
class _Block:
    """Memory, and who has it."""

    memory: np.ndarray
    tenant: Callable[[], np.ndarray | None] = lambda: None


@functools.cache
def _blocks() -> tuple[list[_Block], threading.Lock]:
    """Given out by `room`, the latest last."""
    return [], threading.Lock()


def threads() -> int:
    """How many threads kernels use: torch's number, so one setting (or OMP_NUM_THREADS) rules both; inside
    `torch_on_one_thread` what that was before."""
    return getattr(_OUTSIDE, "threads", None) or torch.get_num_threads()


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """For work that mostly draws; a decorator, too. What torch itself does between kernels is little: its threads wait
    for each other in each operation, which takes longer than it saves, and far longer where another process has one of
    their cores. Besides, the same is computed with any number of threads."""
    given, of_torch = getattr(_OUTSIDE, "threads", None), torch.get_num_threads()
    _OUTSIDE.threads = given or of_torch
    torch.set_num_threads(1)
    try:
        yield
    finally:
        _OUTSIDE.threads = given
        torch.set_num_threads(of_torch)


def parallel_for(function: Callable, *arguments, gaussians: int = FEW) -> None:
    """Call `function(tickets, *arguments)` on every thread at once; they draw tickets until the work is gone.

    `tickets` [2] int64: a counter to draw from with `vectors.take_ticket`, and the number of threads. What a piece of
    work writes must depend on its number only, so that results are the same for any number of threads.

    Args:
        gaussians: how many there are to look at, where that is all the work; fewer than FEW are left to this thread.
    """
    helpers = threads() - 1 if gaussians >= FEW else 0
    tickets = np.array([0, helpers + 1])
    pending = [_pool(os.getpid(), helpers).submit(function, tickets, *arguments) for _ in range(helpers)]
    function(tickets, *arguments)
    for future in pending:
        if not future.cancel():  # a helper that never woke up has nothing left to do
            future.result()


def side_by_side(function: Callable[[T], R], items: Iterable[T], most: int = 8) -> Iterator[R]:
    """`function` of each item in their order, as many at once as there are threads, `most` at most: for work whose
    array operations let other threads run; these share out the threads that there are. Where it is left early, what
    has not begun is not done."""
    workers = max(1, min(threads(), most))
    own = max(1, threads() // workers)
    with ThreadPoolExecutor(workers, "beside", initializer=torch.set_num_threads, initargs=(own,)) as pool:
        try:
            yield from pool.map(function, items)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


@functools.lru_cache(maxsize=1)
def _pool(process: int, helpers: int) -> ThreadPoolExecutor:
    """Waiting threads; a forked process makes its own."""
    return ThreadPoolExecutor(helpers, thread_name_prefix="splat")
