"""As many threads as pay: small maps leave little to share, and one that waits for a busy core holds up the rest."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Self

import torch

from reffusion.io.machine import idle_seconds

MEASURED = 3  # steps at first that are done on one thread, to know what that takes
RECENT = 2  # steps whose fastest is compared: one that was held up by chance counts for nothing
WORTH = 50  # steps from which it is worth to measure
FREE = 0.8  # part of a core's time that nobody wants, from which it counts as free


class Threads:
    """Torch's threads for the steps of a long work on the CPU: all, where cores are free while one thread works at
    first, and until all take longer than that one did. Beside a busy core two may take ten times as long as one.

    A context, after which torch has as many as before. A step's sums are rounded differently by another number.

    Attributes:
        all: torch's own number at the beginning. now: that of the next step.
    """

    def __init__(self, steps: int, device: torch.device, idle: Callable[[], float] = idle_seconds):
        self.all = self.now = torch.get_num_threads()
        self._choosing = steps >= WORTH and self.all > 1 and device.type == "cpu"
        self._one, self._recent = float("inf"), list[float]()
        self._done, self._idle, self._began = 0, idle, (0.0, 0.0)

    def __enter__(self) -> Self:
        self._take(1 if self._choosing else self.all)
        self._began = self._idle(), time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        torch.set_num_threads(self.all)

    def _take(self, count: int) -> None:
        self.now = count
        torch.set_num_threads(count)

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
                self._take(self.all if self._choosing else 1)
            return
        self._recent = [*self._recent, seconds][-RECENT:]
        if len(self._recent) == RECENT and min(self._recent) > self._one:
            self._take(1)
            self._choosing = False

    def _others_are_free(self) -> bool:
        idle, began = self._began
        wanted = FREE * (self.all - 1) * (time.perf_counter() - began)
        return idle == float("inf") or self._idle() - idle >= wanted
