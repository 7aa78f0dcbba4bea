"""The tiny runner: it knows files, hashes and YAML, and nothing of 3D. Its way is resolve -> plan -> execute.

- resolve.py: a request becomes a job, in which all is settled: scene, profile, parameters of all stages, folders.
  - pipeline.py: pipeline.yaml and scene.yaml: models, clear refusals.
  - layers.py: parameters, layer over layer, and a time budget shared out over stages.
- plan.py: one word and a reason for each stage, from what lies on the disk.
  - keys.py: what an artifact depends on, as hashes: contents of folders, code, parameters.
- execute.py: does it: a fresh process a stage, folders renamed into place, receipts.
  - artifacts.py: what of one is as its receipt says, and swaps that survive a kill.
  - files.py: files written whole, locks, and copies that people work with.
- upkeep.py: what was made is verified, or removed.
- child.py: the other side: the process in which stages are imported.
- compare.py: many runs.
"""


class Refused(Exception):
    """What the user can put right, told in one line before any work."""


class Failed(Exception):
    """A stage could not do its work, told in one line."""


def say(text: str) -> None:
    print(text, flush=True)
