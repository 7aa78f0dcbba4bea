"""The runner: resolves a request, plans which stages must run, and executes them.

It knows files, hashes and YAML, and nothing about 3D. Terms:

- A *request* is what a user asks for on the command line. A *job* is a request with everything resolved and checked.
- The *artifact* of a stage is the folder runs/<scene>/<stage>/ with its result. Its *receipt*, receipt.json, records
  all inputs and the hashes of all files. The *key* of an artifact is a hash of its inputs, without parameters that do
  not change the result.
- A *profile* is a set of parameters in pipeline.yaml. A *variant* (baseline or ablation) overrides some of them, and
  its folder is runs/<scene>@<variant>/.
- A *need* of a stage is an earlier stage whose artifact it reads, or `scene`, the folder of the scene.

Modules:

- resolve.py: turns a request into a job with its scene, profile, folders and the parameters of all stages.
  - pipeline.py: the models of pipeline.yaml and scene.yaml, and their checks.
  - user_yaml.py: a YAML reader for files that people write.
  - parameters.py: merges the layers of parameters, and splits a time budget over stages.
  - frames.py: extracts the frames of a video, which become a scene.
- plan.py: gives each stage a status and a reason, from the files on disk.
  - keys.py: hashes of everything that an artifact depends on: contents of folders, code, parameters.
  - plan_table.py: a plan as text. durations.py: expected times.
- execute.py: runs stages, each in a new process, writes receipts, and renames folders into place.
  - artifacts.py: compares artifacts with their receipts, and replaces them so that a killed runner loses nothing.
  - files.py: atomic writes, locks, exported copies.
- worker.py: the process that imports stages. process.py: starts this process, sends it questions, runs stages in it.
- results.py: prints scores, and records plans for report/.
- text.py: errors, sizes, times, names and paths as text.
- fleet/: commands on many scenes, variants or machines, and those beside a run. Only __main__.py imports it.
  - commands.py: their command lines.
  - compare.py: the commands `compare` and `batch`. parallel.py: several runs at once. progress.py: shows each.
  - engine.py: shares this machine among stages; on a cluster: ray_engine.py, slurm_engine.py, retry.py.
  - maintenance.py: verifies or removes artifacts. garbage.py: removes artifacts that no plan uses.
  - weights.py: lists and fetches the weights that stages need.
"""

from contextvars import ContextVar
from typing import TextIO


class Refused(Exception):
    """An error that the user can correct, with a message of one line. It is mostly raised before any stage runs."""


class Failed(Exception):
    """The failure of a stage, with a message of one line."""


OUTPUT: ContextVar[TextIO | None] = ContextVar("output", default=None)  # where `say` prints; None: standard output


def say(text: str) -> None:
    """Print a message to the file in OUTPUT, which each thread may set for itself, or else to standard output."""
    print(text, file=OUTPUT.get(), flush=True)
