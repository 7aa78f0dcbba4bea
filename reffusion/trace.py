"""Error against time, checkpoints, seeded generators, progress: what every long stage needs."""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

CHECKPOINT = "checkpoint.pt"


def seed_for(seed: int, *labels: object) -> int:
    """A 63-bit seed that depends on every label: `seed_for(0, "sds", iteration)`.

    Drawing each step's randomness from its own seed makes a resumed run equal to an unbroken one.
    """
    text = repr((seed, *labels)).encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "little") >> 1


def generator(seed: int, *labels: object, device: str = "cpu") -> torch.Generator:
    """A fresh generator on `device` for this seed and these labels."""
    return torch.Generator(device).manual_seed(seed_for(seed, *labels))


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Write `folder/checkpoint.pt` at once or not at all. `state` holds tensors and plain Python values."""
    partial = folder / (CHECKPOINT + ".writing")
    with open(partial, "wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, folder / CHECKPOINT)


def load_checkpoint(folder: Path) -> dict[str, Any] | None:
    """The state last saved in `folder`, or None. The runner hands a stage only folders of its own key."""
    path = folder / CHECKPOINT
    return torch.load(path, weights_only=True) if path.exists() else None


def clear_checkpoint(folder: Path) -> None:
    """Remove what `save_checkpoint` wrote: the stage is done."""
    (folder / CHECKPOINT).unlink(missing_ok=True)
    (folder / (CHECKPOINT + ".writing")).unlink(missing_ok=True)


class Trace:
    """`trace.jsonl`: one line per moment, {"seconds", "iteration", <error name>: value, ...}.

    The clock counts work only: it stops inside `with trace.paused():` and continues from `start_seconds`
    after a resume; lines past the resumed iteration are dropped.
    """

    def __init__(self, folder: Path, start_seconds: float = 0.0, start_iteration: int = 0):
        self.path = folder / "trace.jsonl"
        kept = [r for r in read_trace(self.path) if r["iteration"] < start_iteration] if self.path.exists() else []
        partial = self.path.with_suffix(".writing")
        partial.write_text("".join(json.dumps(r) + "\n" for r in kept))
        os.replace(partial, self.path)
        self._offset, self._since = start_seconds, time.perf_counter()

    @property
    def seconds(self) -> float:
        return self._offset + time.perf_counter() - self._since

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stop the clock while something is measured or drawn."""
        began = self.seconds
        try:
            yield
        finally:
            self._offset, self._since = began, time.perf_counter()

    def log(self, iteration: int, **errors: float) -> None:
        record = {"seconds": round(self.seconds, 4), "iteration": iteration, **errors}
        with open(self.path, "a") as file:
            file.write(json.dumps(record) + "\n")


def read_trace(path: Path) -> list[dict[str, float]]:
    """The records of a `trace.jsonl`; a line cut off by a kill is ignored."""
    records = []
    for line in path.read_text().splitlines():
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return records


def log_spaced(iteration: int, last: int, per_octave: int = 2) -> bool:
    """True at the first and last iteration and `per_octave` times in each doubling between: when to measure."""
    if iteration in (0, last):
        return True
    from math import floor, log2

    step = lambda i: floor(log2(i) * per_octave)
    return iteration > 0 and step(iteration) != step(max(iteration - 1, 0.5))


def progress(total: int, label: str, start: int = 0) -> Iterator[int]:
    """`range(start, total)` with a bar that shows the time left; one line every few seconds where no one watches."""
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
