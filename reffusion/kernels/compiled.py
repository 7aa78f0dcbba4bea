"""Compilation of numba kernels, a cache of their machine code, and their execution on several threads.

A kernel here is a function compiled by numba. The threads that run a kernel divide its work by *tickets*: a ticket is
the number of a piece of the work, and each thread takes the next one until none is left.
"""

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
# Least size, in numbers, of an array whose memory is reused; and how many blocks of memory are kept, about as many as
# two optimization steps need.
_MIN_KEPT, _MAX_BLOCKS = 2**16, 24
MIN_PARALLEL = 8000  # Gaussians below which another thread costs more time than it saves
# Fast-math flags of LLVM. The order and rounding of operations may change, but NaN and infinity are preserved, because
# `fit` checks for them.
FREE_ROUNDING = "contract", "reassoc", "nsz", "arcp"
_PACKAGES = "kernels", "splat", "gaussians", "depth", "background", "inpaint/patchmatch"  # packages with kernels
# Inside `torch_on_one_thread`, torch's number of threads outside of it. It is thread-local, as torch's number itself.
_torch_threads = threading.local()
MAX_VIEWS = 4  # views that are processed at once; all arrays of each are in memory
_CACHE = "splat-"  # prefix of the folder of machine code in __pycache__; its name ends in a hash of the sources


@functools.cache
def _cache_folder() -> Path:
    """Return the folder of machine code for the present sources of `_PACKAGES`."""
    library = Path(__file__).parents[1]
    sources = [path for package in _PACKAGES for path in sorted((library / package).glob("*.py"))]
    # numba itself checks only whether the file of a function has changed. It would go on using machine code with an old
    # constant or an old callee from another file.
    digest = hashlib.blake2b(b"".join(path.read_bytes() for path in sources), digest_size=8).hexdigest()
    return Path(__file__).parent / "__pycache__" / (_CACHE + digest)


def kernel(function: Callable, fastmath: tuple[str, ...] = ()) -> Callable:
    """Return `function` as a numba kernel that runs without the GIL.

    The kernel is compiled at the first call; later processes load the machine code from disk. Machine code that other
    versions of the sources left in the cache is deleted. Assigning an array to a slice of another takes two seconds to
    compile, since numba compiles the error message, too; a loop does not.

    Args:
        function: the function to compile.
        fastmath: LLVM's fast-math flags, such as `FREE_ROUNDING`.
    """
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
    """Return `function` compiled so that it is inlined into every kernel that calls it."""
    return numba.njit(forceinline=True, error_model="numpy")(function)


def empty_aligned(*shape: int) -> np.ndarray:
    """Return an uninitialized float32 array of this shape, aligned to cache lines.

    A large array takes the memory of an earlier array that no longer exists. Otherwise the system would provide new
    pages of memory each time, and clearing these takes much of an optimization step.
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
        # Made through a memoryview, so that the base of each view of this array is this array, and not the block's
        # memory. So the array exists, and the block is in use, as long as any view of it exists.
        array = np.frombuffer(block.memory.data, np.float32, size)
        block.tenant = weakref.ref(array)
        return array.reshape(shape)


def _cache_aligned(size: int) -> np.ndarray:
    """Return an uninitialized float32 array [size] in new memory, aligned to cache lines of 64 bytes."""
    memory = np.empty(size + 16, np.float32)
    first = -memory.ctypes.data // 4 % 16
    return memory[first : first + size]


@dataclass
class _Block:
    """A block of memory that `empty_aligned` reuses.

    Attributes:
        memory: [K] float32.
        tenant: weak reference to the array that uses the memory; it returns None if this array no longer exists.
    """

    memory: np.ndarray
    tenant: Callable[[], np.ndarray | None] = lambda: None


@functools.cache
def _blocks() -> tuple[list[_Block], threading.Lock]:
    """Return the blocks of memory that `empty_aligned` keeps, the last used one last, and the lock of this list."""
    return [], threading.Lock()


def threads() -> int:
    """Return the number of threads for kernels: torch's number, so that one setting (or OMP_NUM_THREADS) controls both.

    Inside `torch_on_one_thread`, where torch's number is 1, the result is the number that torch had before.
    """
    return getattr(_torch_threads, "threads", None) or torch.get_num_threads()


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Let torch use one thread, for work that mostly renders; a context manager, also usable as a decorator.

    Torch's operations between kernels are small. In each of them, synchronizing threads takes longer than the threads
    save, and far longer if another process occupies a core. Besides, results then do not depend on the number of
    threads. Kernels still use `threads()` threads.
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
    """Call `function(tickets, *arguments)` on all threads at once, and return when all have returned.

    Each call takes tickets (numbers of pieces of work) by `vectors.take_ticket(tickets)` until none is left. Results
    are the same for any number of threads if what a piece of work writes depends only on its number.

    Args:
        function: a kernel. Its first argument `tickets` [2] int64 holds the counter of tickets and the number of
            threads.
        arguments: its other arguments.
        gaussians: number of Gaussians, if it determines the amount of work. Below `MIN_PARALLEL` only the calling
            thread is used; the default uses all threads.
    """
    helpers = threads() - 1 if gaussians >= MIN_PARALLEL else 0
    tickets = np.array([0, helpers + 1])
    pending = [_pool(os.getpid(), helpers).submit(function, tickets, *arguments) for _ in range(helpers)]
    function(tickets, *arguments)
    for future in pending:
        if not future.cancel():  # a call that has not begun by now finds no ticket left, and need not run
            future.result()


def views_at_once(device: str | torch.device) -> int:
    """Return how many views `map_in_threads` should process at once: `MAX_VIEWS` on a CPU, one on any other device."""
    return MAX_VIEWS if torch.device(device).type == "cpu" else 1


def map_in_threads(function: Callable[[T], R], items: Iterable[T], most: int = 8) -> Iterator[R]:
    """Yield `function(item)` for each item, in order; several items are computed at once, each in one thread.

    This is useful for functions whose array operations release the GIL. Torch's threads are divided among the items. If
    the iteration ends early, items whose computation has not begun are canceled.

    Args:
        most: largest number of items at once, which `threads()` limits too.
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
    """Return a pool of `helpers` threads that is kept between calls of the process with the id `process`."""
    # Threads do not survive a fork, so a forked process makes its own pool.
    return ThreadPoolExecutor(helpers, thread_name_prefix="splat")
