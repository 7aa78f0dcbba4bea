"""What weights a profile needs, whether they are here, how much there is to fetch; and their download."""

from __future__ import annotations

import json
import sys
from typing import Any

from runner.describe import Described, child, described, questions
from runner.pipeline import SceneFile, load_pipeline
from runner.plan import amount
from runner.resolve import Request, brought, resolve, settled


def weights(request: Request, offline: bool) -> int:
    """Show the weights of all stages, of a scene where one is named, and fetch what is missing unless `offline`.

    Returns how many that a stage cannot do without are missing in the end.
    """
    profile, why, stages, brings = _asked(request)
    users: dict[str, list[str]] = {}
    needs: dict[str, dict[str, Any]] = {}
    for stage, each in stages.items():
        for need in each.needed:
            users.setdefault(need["name"], []).append(stage)
            needs.setdefault(need["name"], need)
    missing = [need for need in needs.values() if need["problem"]]
    to_fetch = [need for need in missing if need["fetched"]]
    print(f"weights of profile {profile} ({why})")
    for name, need in needs.items():
        state = "here" if not need["problem"] else "to fetch" if need["fetched"] else "broken"
        print(f"  {state:<9} {amount(need['bytes']):>12}  {name}  ({', '.join(users[name])})")
    for need in missing:
        if not need["fetched"]:
            print(f"error: {need['problem']}", file=sys.stderr)
    unsized = " and what has no known size" if any(need["bytes"] is None for need in to_fetch) else ""
    print(f"to fetch: about {amount(sum(need['bytes'] or 0 for need in to_fetch))}{unsized}", flush=True)
    broken = len(missing) - len(to_fetch)
    if offline or not to_fetch:
        return broken + sum(not need["optional"] for need in to_fetch)
    process = child(request.root, "fetch")
    asked = {stage: {"params": each.params, "brings": brings} for stage, each in stages.items()}
    process.communicate(json.dumps(asked))
    return broken + process.returncode


def _asked(request: Request) -> tuple[str, str, dict[str, Described], list[str]]:
    """(profile, why, the stages' words, what the scene brings)."""
    if request.scene:
        job = resolve(request)
        return job.profile, job.why, job.stages, brought(job.brings, job.folder)
    pipeline = load_pipeline(request.root)
    profile, why, layers = settled(request, pipeline, SceneFile(request.root / "scene.yaml", None, {}, {}), [])
    stages, _ = described(request.root, pipeline, layers, questions(request.root, pipeline, layers, []))
    return profile, why, stages, []
