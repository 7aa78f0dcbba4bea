"""The full method and every variant of pipeline.yaml, on a scene or on several, and a record of where each lies."""

from __future__ import annotations

import os
import re
import sys
import time
from dataclasses import replace
from typing import Any

from runner import Failed, Refused, say
from runner.execute import run_scene
from runner.files import shown, write_json
from runner.pipeline import Pipeline, find_scene, load_pipeline, unknown
from runner.resolve import Memory, Request, resolve_all

FULL = "full"  # what the scene's own run, without a variant, is called beside them
RECORD = "compare.json"
WAITING, DONE, FAILED = "not run yet", "done", "failed"


def compare(request: Request, only: str = "", seeds: int = 1) -> int:
    """Bring the full method and the variants up to date, and write runs/<scene>/compare.json; how many failed.

    What is cached is not run again, so the same command goes on after a kill. A variant that fails stops no other.

    Args:
        only: names of variants, with commas or blanks between; empty for all of pipeline.yaml.
        seeds: on so many scenes: X, X-1, ..., X-<seeds - 1>.

    Raises:
        Refused: before any work, where a variant, a scene or a parameter is not right.
    """
    if request.variant:
        raise Refused(f"variant={request.variant}: compare runs all variants; variants={request.variant} picks some")
    methods = [FULL, *_chosen(only, load_pipeline(request.root))]
    scenes = _scenes(request, seeds)
    requests = {
        (scene, method): replace(request, scene=scene, variant=None if method == FULL else method)
        for scene in scenes
        for method in methods
    }
    memory = Memory(request.runs)
    # Wrong parameters of any variant, or of any scene, are refused before the first stage runs.
    resolve_all([r for (scene, method), r in requests.items() if scene == scenes[0] or method == FULL], memory)
    names = {scene: find_scene(scene, request.root).name for scene in scenes}
    runs = [{"scene": names[scene], "method": method, "state": WAITING} for scene, method in requests]
    record = {"scene": names[scenes[0]], "scenes": list(names.values()), "methods": methods, "runs": runs}
    home = request.runs / record["scene"]
    home.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    for number, (run, asked) in enumerate(zip(runs, requests.values(), strict=True), 1):
        write_json(home / RECORD, record)
        minutes = (time.monotonic() - began) / 60
        say(f"\ncompare: {run['method']} on {run['scene']}, {number} of {len(runs)}, {minutes:.0f} min so far")
        run |= _done(asked, memory)
    write_json(home / RECORD, record)
    failed = [run for run in runs if run["state"] == FAILED]
    say("")
    for run in failed:
        say(f"failed: {run['method']} on {run['scene']}: {run['error']}")
    say(f"compare: {len(runs) - len(failed)} of {len(runs)} done; {shown(home / RECORD)} says where")
    return len(failed)


def _done(request: Request, memory: Memory) -> dict[str, Any]:
    """Run one; its state, and stage -> the artifact's folder below runs/, null where the stage is left out."""
    try:
        stages = run_scene(request, "all", memory)
    except (Refused, Failed) as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        return {"state": FAILED, "error": str(error)}
    return {"state": DONE, "stages": {s: path and os.path.relpath(path, request.runs) for s, path in stages.items()}}


def _chosen(only: str, pipeline: Pipeline) -> list[str]:
    if FULL in pipeline.variants:
        raise Refused(f"pipeline.yaml: a variant is called {FULL!r}, which is what compare calls the whole method")
    asked = [name for name in re.split(r"[,\s]+", only) if name and name != FULL]
    for name in asked:
        if name not in pipeline.variants:
            raise Refused(f"variants: {unknown('variant', name, pipeline.variants)}")
    return list(dict.fromkeys(asked)) if only else list(pipeline.variants)


def _scenes(request: Request, seeds: int) -> list[str]:
    if seeds < 1:
        raise Refused(f"seeds={seeds}: on how many scenes; 1 or more")
    scenes = [request.scene, *(f"{request.scene.rstrip('/')}-{seed}" for seed in range(1, seeds))]
    for scene in scenes[1:]:
        try:
            find_scene(scene, request.root)
        except Refused as error:
            raise Refused(f"seeds={seeds} asks for the scenes {scenes[0]} to {scenes[-1]}: {error}") from None
    return scenes
