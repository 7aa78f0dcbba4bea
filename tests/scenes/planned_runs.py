"""Plans of this project's stages, and artifacts that the plan takes for those of a finished run."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict

from runner.artifacts import hash_contents
from runner.plan import Decision, decide
from runner.resolve import ResolvedJob


def decide_stages(job: ResolvedJob, stages: Iterable[str]) -> dict[str, Decision]:
    """Return stage -> decision, for stages in the order of the pipeline."""
    decisions: dict[str, Decision] = {}
    for stage in stages:
        decisions[stage] = decide(job, stage, decisions)
    return decisions


def pretend_to_run(job: ResolvedJob, stages: Iterable[str]) -> dict[str, Decision]:
    """Write an artifact with a receipt for each stage that would run; return the decisions after that."""
    decisions: dict[str, Decision] = {}
    for stage in stages:
        decisions[stage] = decide(job, stage, decisions)
        if decisions[stage].status == "run":
            place, inputs = job.home / stage, decisions[stage].inputs
            (place / "masks").mkdir(parents=True, exist_ok=True)
            (place / "masks" / "v00.png").write_text(stage)
            (place / "facts.json").write_text(json.dumps({"invent_pixels": 7}))
            receipt = asdict(inputs) | {"key": inputs.key} | hash_contents(place, job.hashes)
            (place / "receipt.json").write_text(json.dumps(receipt))
            decisions[stage] = decide(job, stage, decisions)
    return decisions
