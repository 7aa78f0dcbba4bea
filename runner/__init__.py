"""The runner: resolves a request, plans what must run, and executes it. It knows files, hashes and YAML, not 3D.

- resolve.py: turns a request into a job with its scene, profile, folders and the parameters of all stages.
  - pipeline.py: the models of pipeline.yaml and scene.yaml, and their checks.
  - user_yaml.py: a YAML reader for files that people write.
  - parameters.py: merges the layers of parameters, and splits a time budget over stages.
  - frames.py: a video as a scene.
- plan.py: gives each stage a status and a reason, from what is on disk.
  - keys.py: hashes of what an artifact depends on: contents of folders, code, parameters.
  - gpu_costs.py: expected time and memory of stages on a GPU.
- execute.py: runs stages, each in a fresh process; writes receipts; renames folders into place.
  - engine.py: where that process runs: on this machine, or on a cluster (ray_engine.py, slurm_engine.py, retry.py).
  - artifacts.py: compares artifacts with their receipts, and replaces them so that a kill loses nothing.
  - files.py: atomic writes, locks, exported copies.
- worker.py: the process that imports stages; process.py: starts it and asks it.
- compare.py: many runs: `compare` and `batch`.
  - parallel.py: several runs at once; progress.py: how far each one is.
- results.py: prints scores; calls report/ for tables and pages.
- maintenance.py: verifies artifacts or removes them; garbage.py: removes those that no plan uses.
- weights.py: lists and fetches the weights that stages need.
- text.py: errors, sizes, times and paths as text.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar


class Refused(Exception):
    """The user can fix this. One line, raised before any work."""


class Failed(Exception):
    """A stage failed. One line."""


def say(text: str) -> None:
    """Print a message, or pass it to the function set by `redirect_output`."""
    redirect = _redirect.get()
    print(text, flush=True) if redirect is None else redirect(text)


@contextmanager
def redirect_output(redirect: Callable[[str], None]) -> Iterator[None]:
    """Pass the messages of this thread to `redirect` inside the context."""
    token = _redirect.set(redirect)
    try:
        yield
    finally:
        _redirect.reset(token)


_redirect: ContextVar[Callable[[str], None] | None] = ContextVar("redirect", default=None)
