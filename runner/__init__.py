"""The tiny runner: it knows files, hashes and YAML, and nothing of 3D.

- pipeline.py: pipeline.yaml and scene.yaml: models, layers of parameters, clear refusals.
- budget.py: a time budget, shared out over stages.
- keys.py: what an artifact depends on, as hashes: contents of folders, code, parameters.
- job.py: a request with everything about it resolved and checked.
- plan.py: one word and a reason for each stage, from what lies on the disk.
- compare.py: a scene's own run and every variant of it.
- execute.py: locks, fresh processes, folders renamed into place, receipts, batches.
- weights.py: what weights a profile needs, their sizes, and their download.
- child.py: the other side: the process in which stages are imported.
"""
