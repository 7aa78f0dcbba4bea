"""The choice of how many threads process the samples of a training step, each thread with samples of its own.

The feature maps of one sample are too small to be split between threads. Threads that wait for each other in every
operation are also delayed by any other process.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Self

import torch

from reffusion.io.machine import idle_seconds

CALIBRATION_STEPS = 3  # first steps, run on one thread to measure their time
RECENT_STEPS = 2  # last steps, of which the fastest is compared, so that one delayed by chance does not count
MIN_STEPS = 50  # shorter runs are not measured
FREE_SHARE = 0.8  # share of idle time from which a core counts as free


class Threads:
    """A pool of threads for the steps of a long training on the CPU, used as a context manager.

    The first steps run on one thread. If the other cores were idle during these steps, all threads of torch are used
    afterwards, each for a part of the samples. If they were busy, or if steps on all threads take longer than the first
    steps did, one thread is used to the end.

    Inside the context torch uses one thread per part; at its end torch's number of threads is restored. In short runs
    (fewer than `MIN_STEPS` steps) and on a GPU the number of threads is not changed. The sums of a step are rounded
    differently with another number of threads.

    Args:
        steps: Number of steps of the training.
        device: The device of the training.
        idle: Returns the idle time of all cores so far, in seconds; inf if it is unknown.

    Attributes:
        all: Number of threads of torch at the beginning.
        now: Number of parts of the next step that are processed at the same time.
    """

    def __init__(self, steps: int, device: torch.device, idle: Callable[[], float] = idle_seconds):
        self.all, self.now = torch.get_num_threads(), 1
        self._choosing = steps >= MIN_STEPS and self.all > 1 and device.type == "cpu"
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
        """Return an iterator over `function` of each part, in order, computed for `now` parts at the same time.

        `function` must set thread-local state of torch, such as no_grad, by itself.
        """
        return self._pool.map(function, parts) if self.now > 1 else map(function, parts)

    @contextmanager
    def step(self) -> Iterator[None]:
        """Measure the time of a step, and choose the number of threads for the next steps.

        The step is the body of the `with` statement.
        """
        began = time.perf_counter()
        yield
        seconds = time.perf_counter() - began
        self._done += 1
        if not self._choosing:
            return
        if self._done <= CALIBRATION_STEPS:
            self._one = min(self._one, seconds)
            if self._done == CALIBRATION_STEPS:
                self._choosing = self._others_are_free()
                self.now = self.all if self._choosing else 1
            return
        self._recent = [*self._recent, seconds][-RECENT_STEPS:]
        if len(self._recent) == RECENT_STEPS and min(self._recent) > self._one:
            self.now, self._choosing = 1, False

    def _others_are_free(self) -> bool:
        idle, began = self._began
        needed = FREE_SHARE * (self.all - 1) * (time.perf_counter() - began)
        return idle == float("inf") or self._idle() - idle >= needed
