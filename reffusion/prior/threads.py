"""As many threads as pay, each with samples of its own: the maps of one are too small to be shared, and threads that
wait for each other in each of them are held up by any other process."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Self

import torch

from reffusion.io.machine import idle_seconds

MEASURED = 3  # steps at first that are done on one thread, to know what that takes
RECENT = 2  # steps whose fastest is compared: one that was held up by chance counts for nothing
WORTH = 50  # steps from which it is worth to measure
FREE = 0.8  # part of a core's time that nobody wants, from which it counts as free


class Threads:
    """The threads for the steps of a long work on the CPU: as many as torch has, where cores are free while one thread
    works at first, and until all take longer than that one did.

    A context, in which torch itself takes one thread for each of them, and after which it has as many as before. A
    step's sums are rounded differently by another number. Short works, and those on a card, are left to torch.

    Attributes:
        all: torch's own number at the beginning. now: how many parts of the next step are done at once.
    """

    def __init__(self, steps: int, device: torch.device, idle: Callable[[], float] = idle_seconds):
        self.all, self.now = torch.get_num_threads(), 1
        self._choosing = steps >= WORTH and self.all > 1 and device.type == "cpu"
        self._one, self._recent = float("inf"), list[float]()
        self._done, self._idle, self._began = 0, idle, (0.0, 0.0)

    def __enter__(self) -> Self:
        if self._choosing:
            torch.set_num_threads(1)
        self._pool = ThreadPoolExecutor(self.all, initializer=torch.set_num_threads, initargs=(1,))
        self._began = self._idle(), time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown()
        torch.set_num_threads(self.all)

    def map(self, function: Callable[[Any], Any], parts: Iterable[Any]) -> Iterator[Any]:
        """`function` of each part, in their order; `now` at once. What torch keeps for each thread, such as no_grad, is
        the function's to say."""
        return self._pool.map(function, parts) if self.now > 1 else map(function, parts)

    @contextmanager
    def step(self) -> Iterator[None]:
        """A step is done inside."""
        began = time.perf_counter()
        yield
        seconds = time.perf_counter() - began
        self._done += 1
        if not self._choosing:
            return
        if self._done <= MEASURED:
            self._one = min(self._one, seconds)
            if self._done == MEASURED:
                self._choosing = self._others_are_free()
                self.now = self.all if self._choosing else 1
            return
        self._recent = [*self._recent, seconds][-RECENT:]
        if len(self._recent) == RECENT and min(self._recent) > self._one:
            self.now, self._choosing = 1, False

    def _others_are_free(self) -> bool:
        idle, began = self._began
        wanted = FREE * (self.all - 1) * (time.perf_counter() - began)
        return idle == float("inf") or self._idle() - idle >= wanted
