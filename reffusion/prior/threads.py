"""As many threads as pay: small maps leave little to share, and one that waits for a busy core holds up the rest."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self

import torch

MEASURED = 3  # steps at first that are done on one thread, to know what that takes
RECENT = 2  # steps whose fastest is compared: one that was held up by chance counts for nothing
WORTH = 50  # steps from which it is worth to measure


class Threads:
    """Torch's threads for the steps of a long work on the CPU: all, until those take longer than one takes.

    A context, after which torch has as many as before. A step's sums are rounded differently by another number.

    Attributes:
        all: torch's own number at the beginning. now: that of the next step.
    """

    def __init__(self, steps: int, device: torch.device):
        self.all = self.now = torch.get_num_threads()
        self._choosing = steps >= WORTH and self.all > 1 and device.type == "cpu"
        self._one, self._recent = float("inf"), list[float]()
        self._done = 0

    def __enter__(self) -> Self:
        self._take(1 if self._choosing else self.all)
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
            self._take(1 if self._done < MEASURED else self.all)
            return
        self._recent = [*self._recent, seconds][-RECENT:]
        if len(self._recent) == RECENT and min(self._recent) > self._one:
            self._take(1)
            self._choosing = False
