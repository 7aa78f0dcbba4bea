"""As many threads as pay: small maps leave little to share, and a thread that waits for a busy core holds up the rest."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self

import torch

MEASURED = (1, 2)  # the steps that run on one thread, to know what that takes; the first of all fills caches
RECENT = 3  # steps whose fastest is compared: one that was held up by chance counts for nothing
WORTH = 50  # steps from which it is worth to measure


class Threads:
    """Torch's threads for the steps of a long work on the CPU: all, until those take longer than one takes.

    A context, after which torch has as many as before. A step's sums are rounded differently by another number of threads.

    Attributes:
        all: torch's own number at the beginning. now: that of the next step.
    """

    def __init__(self, steps: int, device: torch.device):
        self.all = self.now = torch.get_num_threads()
        self._one, self._recent = float("inf"), list[float]()
        self._choosing = steps >= WORTH and self.all > 1 and device.type == "cpu"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        torch.set_num_threads(self.all)

    @contextmanager
    def step(self, done: int) -> Iterator[None]:
        """A step is done inside; `done` of them were before it, in this process."""
        trying = self._choosing and done in MEASURED
        torch.set_num_threads(1 if trying else self.now)
        began = time.perf_counter()
        try:
            yield
        finally:
            seconds = time.perf_counter() - began
            torch.set_num_threads(self.now)
        if trying:
            self._one = min(self._one, seconds)
        elif self._choosing and done > max(MEASURED):
            self._recent = [*self._recent, seconds][-RECENT:]
            if len(self._recent) == RECENT and min(self._recent) > self._one:
                self.now, self._choosing = 1, False
                torch.set_num_threads(1)
