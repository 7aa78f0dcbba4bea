"""What weights a profile needs, whether they are here, how much there is to fetch; and their download."""

from __future__ import annotations

import json
import sys
from typing import Any

from runner.job import Request, brought, child, described_stages, prepare
from runner.pipeline import Refused, SceneFile, choose_profile, layered, load_pipeline, parse_set
from runner.plan import amount


def weights(request: Request, offline: bool) -> int:
    """Show the weights of all stages, of a scene where one is named, and fetch what is missing unless `offline`.

    Returns how many that a stage cannot do without are missing in the end.
    """
    profile, why, params, needed, brings = _asked(request)
    users: dict[str, list[str]] = {}
    needs: dict[str, dict[str, Any]] = {}
    for stage, of_stage in needed.items():
        for need in of_stage:
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
    unknown = " and what has no known size" if any(need["bytes"] is None for need in to_fetch) else ""
    print(f"to fetch: about {amount(sum(need['bytes'] or 0 for need in to_fetch))}{unknown}", flush=True)
    broken = len(missing) - len(to_fetch)
    if offline or not to_fetch:
        return broken + sum(not need["optional"] for need in to_fetch)
    process = child(request.root, "fetch")
    process.communicate(json.dumps({stage: {"params": params[stage], "brings": brings} for stage in needed}))
    return broken + process.returncode


def _asked(request: Request) -> tuple[str, str, dict[str, Any], dict[str, list[dict[str, Any]]], list[str]]:
    """(profile, why, params of each stage, weights of each stage, what the scene brings)."""
    if request.scene:
        job = prepare(request)
        return job.profile, job.why, job.params, job.needed, brought(job.brings, job.folder)
    pipeline = load_pipeline(request.root)
    if request.variant and request.variant not in pipeline.variants:
        raise Refused(f"unknown variant {request.variant!r}; known: {', '.join(pipeline.variants) or 'none'}")
    scene = SceneFile(request.root / "scene.yaml", None, {}, {})
    profile, why = choose_profile(request.profile, scene, [], pipeline)
    layers = layered(pipeline, scene, profile, request.variant, parse_set(request.set, pipeline), {})
    described, _ = described_stages(request.root, pipeline, layers, [])
    params = {stage: answer["params"] for stage, answer in described.items()}
    return profile, why, params, {stage: answer["needed"] for stage, answer in described.items()}, []
