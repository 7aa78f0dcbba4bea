"""What long stages share: error over time, checkpoints, a step budget, progress."""

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
# times the duration of the last checkpoint, as the least time between two: under 2 % goes into them
WORK_PER_CHECKPOINT = 50
TRIAL_STEPS = 4  # steps for measuring the speed of a stage


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Write `folder/checkpoint.pt` atomically. `state` holds tensors and plain Python values."""
    partial = folder / (CHECKPOINT + ".writing")
    with open(partial, "wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, folder / CHECKPOINT)


def load_checkpoint(folder: Path) -> dict[str, Any] | None:
    """The state last saved in `folder`; None without one, and with a message where it is damaged.

    The runner hands a stage only folders of its own key.
    """
    path = folder / CHECKPOINT
    if not path.exists():
        return None
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.testzip() is None:  # torch does not look at the checksums that it writes
                return torch.load(path, weights_only=True)
    except Exception:  # of many kinds: whatever a broken file may be taken for
        pass
    print(f"{path} is damaged: from the start", flush=True)
    clear_checkpoint(folder)
    return None


def clear_checkpoint(folder: Path) -> None:
    """Remove what `save_checkpoint` wrote, when the stage is done."""
    (folder / CHECKPOINT).unlink(missing_ok=True)
    (folder / (CHECKPOINT + ".writing")).unlink(missing_ok=True)


class Checkpoints:
    """Decides when a checkpoint is due: `seconds` after the last one, or later where writing took long, as with a
    million Gaussians or a slow disk. The clock starts anew after writing."""

    def __init__(self, folder: Path, seconds: float):
        self._folder, self._seconds = folder, seconds
        self._wait, self._since = seconds, time.monotonic()

    @property
    def due(self) -> bool:
        return time.monotonic() - self._since > self._wait

    def save(self, state: Callable[[], dict[str, Any]]) -> None:
        """Write the state. It is a function, because assembling the state is part of the duration."""
        began = time.monotonic()
        save_checkpoint(self._folder, state())
        self._since = time.monotonic()
        self._wait = max(self._seconds, WORK_PER_CHECKPOINT * (self._since - began))


class Trace:
    """Writes `trace.jsonl`, one line per measurement; docs/development.md#traces describes the lines.

    The clock counts work only: it stops inside `with trace.paused():`, and continues from `start_seconds` after a
    resume, which drops the lines from `start_iteration` on.
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
        return self._offset + (0.0 if self._is_paused else time.perf_counter() - self._since)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stop the clock while something is measured or rendered. May be nested."""
        was_standing = self._is_paused
        self._offset, self._is_paused = self.seconds, True
        try:
            yield
        finally:
            self._since, self._is_paused = time.perf_counter(), was_standing

    def log(self, iteration: int, **errors: float | str) -> None:
        """Append a line; the clock stands still meanwhile. FloatingPointError naming a value that is not finite."""
        for name, value in errors.items():
            if not isinstance(value, str) and not isfinite(value):
                raise FloatingPointError(f"step {iteration}: {name} is {value}")
        with self.paused():
            record = {"seconds": round(self.seconds, 4), "iteration": iteration, **errors}
            with open(self.path, "a") as file:
                file.write(json.dumps(record) + "\n")


def decibels(squared_error: float) -> float:
    """-10 log10 of a mean squared error, at most 100."""
    return -10 * log10(max(squared_error, 1e-10))


def log_spaced(iteration: int, last: int, per_octave: int = 2, first: int = 1) -> bool:
    """Is it time to measure? True at iterations 0, 1 and `last`, and `per_octave` times per doubling from `first`."""
    if iteration in (0, 1, last):
        return True
    step = lambda i: floor(log2(i) * per_octave)
    return iteration >= first and step(iteration) != step(iteration - 1)


def steps_within_budget(
    folder: Path, max_steps: int, seconds: float, elapsed: Callable[[], float], trial: Callable[[Path, int], object]
) -> int:
    """How many steps a stage can do in its `seconds`: between a twentieth of `max_steps` and `max_steps`.

    The answer depends on the machine and its load. It is written to `folder/length.json`, and read back on a resume.

    Args:
        seconds: for the whole stage; 0: no limit, and nothing is measured or written.
        elapsed: returns the seconds used up when the steps begin.
        trial: (folder, count) runs `count` steps with a trace in the folder; must leave everything else unchanged.
    """
    if not seconds:
        return max_steps
    path = folder / LENGTH
    if path.exists():
        return json.loads(path.read_text())["steps"]
    tried = folder / ".trial"
    shutil.rmtree(tried, ignore_errors=True)  # of a run that was killed
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
    """`range(start, total)` with a progress bar and the remaining time; where output is no terminal, one line every few
    seconds."""
    from tqdm import tqdm

    watched = sys.stderr.isatty()
    yield from tqdm(
        range(start, total),
        desc=label,
        initial=start,
        total=total,
        leave=watched,
        mininterval=0.2 if watched else 10.0,
        ascii=not watched,
        file=sys.stderr,
    )
