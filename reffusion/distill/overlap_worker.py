"""Simultaneous execution of two parts of a step: the diffusion prior and the rendering.

The prior's tensors are so small that more threads do not make it faster, so it runs on one thread beside the rendering.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import TypeVar

import torch

T = TypeVar("T")


class OverlapWorker:
    """An executor that runs background work on one thread while the foreground uses the remaining threads.

    Results do not depend on the number of threads.

    Args:
        threads: Total number of threads. With 1 nothing runs at the same time.
    """

    def __init__(self, threads: int):
        self._threads = threads
        one_thread = {"initializer": torch.set_num_threads, "initargs": (1,)}
        self._executor = ThreadPoolExecutor(1, **one_thread) if threads > 1 else None

    @contextmanager
    def overlap(self, work: Callable[[], T]) -> Iterator[Callable[[], T]]:
        """Run `work` while the body of the `with` statement runs; with one thread, run it before the body.

        The context manager gives a function that waits for the result of `work`, and returns it or raises the exception
        of `work`. With one thread this exception is raised before the body. At its end the context manager waits for
        `work`, even if the body raises.
        """
        if self._executor is None:
            result = work()
            yield lambda: result
            return
        torch.set_num_threads(max(1, self._threads - 1))
        future = self._executor.submit(work)
        try:
            yield future.result
        finally:
            wait([future])
            torch.set_num_threads(self._threads)
