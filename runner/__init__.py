"""The tiny runner: it knows files, hashes and YAML, and nothing of 3D. Its way is resolve -> plan -> execute.

- resolve.py: a request becomes a job, in which all is settled: scene, profile, parameters of all stages, folders.
  - pipeline.py: pipeline.yaml and scene.yaml: models, clear refusals.
  - layers.py: parameters, layer over layer, and a time budget shared out over stages.
- plan.py: one word and a reason for each stage, from what lies on the disk.
  - keys.py: what an artifact depends on, as hashes: contents of folders, code, parameters.
- execute.py: does it: a fresh process a stage, folders renamed into place, receipts.
  - engine.py: where that process runs: here, or on a cluster (on_ray.py, on_slurm.py).
  - artifacts.py: what of one is as its receipt says, and swaps that survive a kill.
  - files.py: files written whole, locks, and copies that people work with.
- upkeep.py: what was made is verified, or removed.
- child.py: the other side: the process in which stages are imported.
- compare.py: many runs: which, and their tables.
  - many.py: several at once; progress.py: how far each is.
- sweep.py: what no plan uses any more is listed, and removed.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar


class Refused(Exception):
    """What the user can put right, told in one line before any work."""


class Failed(Exception):
    """A stage could not do its work, told in one line."""


def say(text: str) -> None:
    hear = _hears.get()
    print(text, flush=True) if hear is None else hear(text)


@contextmanager
def said_to(hear: Callable[[str], None]) -> Iterator[None]:
    """While this runs, and in this thread, what is said goes to `hear`."""
    before = _hears.set(hear)
    try:
        yield
    finally:
        _hears.reset(before)


_hears: ContextVar[Callable[[str], None] | None] = ContextVar("hears", default=None)
