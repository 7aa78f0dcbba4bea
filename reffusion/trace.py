"""Tools of the stages that run for long: checkpoints, traces of the error over time, time budgets, progress bars."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import floor, isfinite, log2, log10
from pathlib import Path
from typing import Any

import torch

from reffusion.io.traces import read_trace

CHECKPOINT = "checkpoint.pt"
LENGTH = "length.json"  # holds the number of steps that fit into a time budget
# The least time between two checkpoints is this many times the time that writing the last one took. So writing takes
# less than 2 % of the run time.
WORK_PER_CHECKPOINT = 50
TRIAL_STEPS = 4  # number of steps with which the speed of a stage is measured


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Write a state to `folder/checkpoint.pt` atomically.

    Args:
        state: tensors and plain Python values, also nested.
    """
    partial = folder / (CHECKPOINT + ".writing")
    with open(partial, "wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, folder / CHECKPOINT)


def load_checkpoint(folder: Path) -> dict[str, Any] | None:
    """Return the state that `save_checkpoint` saved last in `folder`, or None if there is none.

    A damaged checkpoint is deleted. The function then prints a message and returns None. The state is not compared
    with the stage's parameters, because the runner gives a stage only folders whose key (the hash of the stage's code,
    parameters and inputs) is the stage's own.
    """
    path = folder / CHECKPOINT
    if not path.exists():
        return None
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.testzip() is None:  # torch writes checksums but does not check them
                return torch.load(path, weights_only=True)
    except Exception:  # a broken file causes exceptions of many types
        pass
    print(f"{path} is damaged: from the start", flush=True)
    clear_checkpoint(folder)
    return None


def clear_checkpoint(folder: Path) -> None:
    """Remove the files that `save_checkpoint` wrote, once the stage is done."""
    (folder / CHECKPOINT).unlink(missing_ok=True)
    (folder / (CHECKPOINT + ".writing")).unlink(missing_ok=True)


class Checkpoints:
    """A schedule of checkpoints that decides when the next one is due, and writes it.

    A checkpoint is due `seconds` after the last one was written, and the first one `seconds` after this object was
    made. If writing took long, as with a million Gaussians or a slow disk, the next checkpoint is due later:
    `WORK_PER_CHECKPOINT` times the duration of writing after the last one.

    Args:
        folder: the folder of the checkpoint. Each checkpoint replaces the one before.
        seconds: least time between two checkpoints.
    """

    def __init__(self, folder: Path, seconds: float):
        self._folder, self._seconds = folder, seconds
        self._wait, self._since = seconds, time.monotonic()

    @property
    def due(self) -> bool:
        """Whether a checkpoint is due."""
        return time.monotonic() - self._since > self._wait

    def save(self, state: Callable[[], dict[str, Any]]) -> None:
        """Write the checkpoint, and restart the time until the next one.

        Args:
            state: a function that returns the state. The time that it takes counts as part of the time for writing.
        """
        began = time.monotonic()
        save_checkpoint(self._folder, state())
        self._since = time.monotonic()
        self._wait = max(self._seconds, WORK_PER_CHECKPOINT * (self._since - began))


class Trace:
    """A writer of `trace.jsonl`, the error over time of a stage, one line per measurement.

    docs/development.md#traces describes the lines. The time in the lines is the time of work since the stage began,
    without the time spent inside `with trace.pause():` and between an interruption and the resumed run.

    Args:
        folder: the folder of the file.
        start_seconds: seconds of work before this run, above 0 if the run is resumed.
        start_iteration: iteration at which this run starts. Of an existing file only the lines of earlier iterations
            are kept, so none with 0.
    """

    def __init__(self, folder: Path, start_seconds: float = 0.0, start_iteration: int = 0):
        self.path = folder / "trace.jsonl"
        kept = [r for r in read_trace(self.path) if r["iteration"] < start_iteration] if self.path.exists() else []
        partial = self.path.with_suffix(".writing")
        partial.write_text("".join(json.dumps(r) + "\n" for r in kept))
        os.replace(partial, self.path)
        self._offset, self._since = start_seconds, time.perf_counter()
        self._is_paused = False

    @property
    def seconds(self) -> float:
        """Seconds of work since the stage began, without pauses, with the earlier runs of a resumed stage."""
        return self._offset + (0.0 if self._is_paused else time.perf_counter() - self._since)

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Exclude the time inside the `with` block from the trace, e.g. for a measurement. Blocks may be nested."""
        was_standing = self._is_paused
        self._offset, self._is_paused = self.seconds, True
        try:
            yield
        finally:
            self._since, self._is_paused = time.perf_counter(), was_standing

    def log(self, iteration: int, **errors: float | str) -> None:
        """Append one line to the trace: "seconds" (see the property `seconds`), "iteration", and the given values.

        The time spent in this call is not counted in "seconds".

        Args:
            iteration: number of finished steps.
            errors: key of the line -> value, e.g. `psnr=20.1`.

        Raises:
            FloatingPointError: a value is not finite; the message names it, and no line is written.
        """
        for name, value in errors.items():
            if not isinstance(value, str) and not isfinite(value):
                raise FloatingPointError(f"step {iteration}: {name} is {value}")
        with self.pause():
            record = {"seconds": round(self.seconds, 4), "iteration": iteration, **errors}
            with open(self.path, "a") as file:
                file.write(json.dumps(record) + "\n")


def decibels(squared_error: float) -> float:
    """Return -10 log10 of a mean squared error, at most 100. For colors in [0, 1] this is the PSNR in dB."""
    return -10 * log10(max(squared_error, 1e-10))


def is_log_step(iteration: int, last: int, per_octave: int = 2, first: int = 1) -> bool:
    """Return whether to measure at this iteration, so that measurements are evenly spaced on a logarithmic scale.

    Args:
        iteration: number of finished steps.
        last: number of the last step, -1 if it is unknown. Iterations 0, 1 and `last` are always measured.
        per_octave: number of measurements while the iteration doubles.
        first: least iteration of the logarithmically spaced measurements.
    """
    if iteration in (0, 1, last):
        return True
    step = lambda i: floor(log2(i) * per_octave)
    return iteration >= first and step(iteration) != step(iteration - 1)


def steps_within_budget(
    folder: Path, max_steps: int, seconds: float, elapsed: Callable[[], float], trial: Callable[[Path, int], object]
) -> int:
    """Return the number of steps that a stage can do in a time budget, from a twentieth of `max_steps` to `max_steps`.

    The speed is measured by a trial of `TRIAL_STEPS` steps, so the result depends on the machine and its load. The
    result is printed, and written to `folder/length.json`. A resumed stage reads it from this file, without a trial.

    Args:
        folder: the stage's folder.
        max_steps: number of steps without a limit.
        seconds: time budget of the whole stage. With 0 there is no limit: the result is `max_steps`, and nothing is
            measured or written.
        elapsed: returns the seconds of the budget that the stage has used so far. It is called after the trial.
        trial: is called as `trial(path, count)` with a temporary folder. It runs `count` steps, writes their trace to
            this folder, and changes nothing else.
    """
    if not seconds:
        return max_steps
    path = folder / LENGTH
    if path.exists():
        return json.loads(path.read_text())["steps"]
    tried = folder / ".trial"
    shutil.rmtree(tried, ignore_errors=True)  # left by a run that was killed
    tried.mkdir(parents=True)
    trial(tried, TRIAL_STEPS)
    at = {line["iteration"]: line["seconds"] for line in read_trace(tried / "trace.jsonl")}
    shutil.rmtree(tried)
    step = (at[TRIAL_STEPS] - at[1]) / (TRIAL_STEPS - 1)  # the first step compiles and fills caches
    steps = min(max_steps, max(-(-max_steps // 20), int((seconds - elapsed()) / max(step, 1e-9))))
    record = {"steps": steps, "of": max_steps, "seconds_per_step": step, "seconds": seconds}
    partial = path.with_suffix(".writing")
    partial.write_text(json.dumps(record) + "\n")
    os.replace(partial, path)
    print(f"{steps} of {max_steps} steps fit into {seconds:.0f} s, at {step:.3g} s each", flush=True)
    return steps


def progress(total: int, label: str, start: int = 0) -> Iterator[int]:
    """Yield `range(start, total)`, and show a progress bar with the remaining time on stderr.

    The remaining time follows from all steps but the first, which may compile kernels. If stderr is not a terminal, one
    line is printed at most every ten seconds instead.

    Args:
        label: text before the bar.
    """
    from tqdm import tqdm

    watched = sys.stderr.isatty()
    with tqdm(
        desc=label,
        initial=start,
        total=total,
        leave=watched,
        mininterval=0.2 if watched else 10.0,
        ascii=not watched,
        file=sys.stderr,
    ) as bar:
        for step in range(start, total):
            yield step
            if step == start:
                bar.unpause()
                bar.n = bar.initial = start + 1
            else:
                bar.update()
