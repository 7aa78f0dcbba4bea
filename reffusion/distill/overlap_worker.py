"""Two things at once: the prior's answer, whose maps are too small for threads to share, beside what only draws."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import TypeVar

import torch

T = TypeVar("T")


class Crew:
    """One thread for the small work, and the others for the rest. The same is computed with any number of threads."""

    def __init__(self, threads: int):
        self._all = threads
        self._helper = ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(1,)) if threads > 1 else None

    @contextmanager
    def beside(self, work: Callable[[], T]) -> Iterator[Callable[[], T]]:
        """Does the work while the body runs, before it where there is one thread only; what it gives by a call, after.

        The body waits for it at its end, whatever happened."""
        if self._helper is None:
            done = work()
            yield lambda: done
            return
        torch.set_num_threads(max(1, self._all - 1))
        doing = self._helper.submit(work)
        try:
            yield doing.result
        finally:
            wait([doing])
            torch.set_num_threads(self._all)
