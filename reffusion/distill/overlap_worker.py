"""Runs two parts of a step at the same time: the prior, whose small tensors gain nothing from more threads, and
rendering."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import TypeVar

import torch

T = TypeVar("T")


class OverlapWorker:
    """One thread for work in the background, the others for the foreground.

    Results do not depend on the number of threads.

    Args:
        threads: in all; with 1 nothing overlaps.
    """

    def __init__(self, threads: int):
        self._threads = threads
        one_thread = {"initializer": torch.set_num_threads, "initargs": (1,)}
        self._executor = ThreadPoolExecutor(1, **one_thread) if threads > 1 else None

    @contextmanager
    def overlap(self, work: Callable[[], T]) -> Iterator[Callable[[], T]]:
        """Does `work` while the body of the `with` statement runs; before it if there is one thread only.

        Gives a function that returns the result of `work` or raises its exception. The context waits for `work` at its
        end, even if the body raises.
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
