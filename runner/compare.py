"""Many runs: `compare`, the full method and every variant on a scene or several; `batch`, every scene of a folder."""

import csv
import io
import json
import os
import re
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from runner import Refused, say
from runner.execute import run_scene
from runner.files import RECEIPT, shown, told, write_json, write_text
from runner.keys import HASHES, Hashes
from runner.pipeline import Pipeline, find_scene, load_pipeline, unknown
from runner.resolve import Request, resolve_all

FULL = "full"  # what the scene's own run, without a variant, is called beside them
RECORD = "compare.json"
WAITING, DONE, FAILED = "not run yet", "done", "failed"


def compare(request: Request, only: str = "", seeds: int = 1) -> int:
    """Bring the full method and the variants up to date, and write runs/<scene>/compare.json; how many failed.

    What is cached is not run again, so the same command goes on after a kill. A variant that fails stops no other.
    `only` names variants, with commas or blanks between (all where empty); `seeds` counts scenes: X, X-1, X-2 ...
    Raises Refused before any work, where a variant, a scene or a parameter is not right."""
    if request.variant:
        raise Refused(f"variant={request.variant}: compare runs all variants; variants={request.variant} picks some")
    methods = [FULL, *_chosen(only, load_pipeline(request.root))]
    scenes = _scenes(request, seeds)
    asks = lambda scene, method: replace(request, scene=scene, variant=None if method == FULL else method)
    requests = {(scene, method): asks(scene, method) for scene in scenes for method in methods}
    hashes = Hashes(request.runs / HASHES)
    _refuse_wrong(scenes, requests, hashes)
    names = {scene: find_scene(scene, request.root).name for scene in scenes}
    runs = [{"scene": names[scene], "method": method, "state": WAITING} for scene, method in requests]
    record = {"scene": names[scenes[0]], "scenes": list(names.values()), "methods": methods, "runs": runs}
    home = request.runs / record["scene"]
    began = time.monotonic()
    for number, (run, asked) in enumerate(zip(runs, requests.values(), strict=True), 1):
        write_json(home / RECORD, record)
        minutes = (time.monotonic() - began) / 60
        say(f"\ncompare: {run['method']} on {run['scene']}, {number} of {len(runs)}, {minutes:.0f} min so far")
        stages, error = _tried(asked, hashes)
        where = {stage: path and os.path.relpath(path, request.runs) for stage, path in stages.items()}
        run |= {"state": FAILED, "error": error} if error else {"state": DONE, "stages": where}
    write_json(home / RECORD, record)
    failed = [run for run in runs if run["state"] == FAILED]
    say("")
    for run in failed:
        say(f"failed: {run['method']} on {run['scene']}: {run['error']}")
    say(f"compare: {len(runs) - len(failed)} of {len(runs)} done; {shown(home / RECORD)} says where")
    return len(failed)


def _refuse_wrong(scenes: list[str], requests: dict[tuple[str, str], Request], hashes: Hashes) -> None:
    """Before the first stage runs: wrong parameters, of any variant. A scene that cannot be read fails in its turn,
    where another can."""
    refusals = []
    for each in scenes:
        try:
            resolve_all([request for (scene, _), request in requests.items() if scene == each], hashes)
            return
        except Refused as error:
            refusals.append(error)
    raise refusals[0]


def _tried(request: Request, hashes: Hashes) -> tuple[dict[str, Path | None], str | None]:
    """Run one: stage -> its artifact, and what went wrong."""
    try:
        return run_scene(request, "all", hashes), None
    except Exception as error:  # of whatever kind: it must not keep others waiting
        print(f"error: {told(error)}", file=sys.stderr, flush=True)
        return {}, told(error)


def _chosen(only: str, pipeline: Pipeline) -> list[str]:
    if FULL in pipeline.variants:
        raise Refused(f"pipeline.yaml: a variant is called {FULL!r}, which is what compare calls the whole method")
    asked = [name for name in re.split(r"[,\s]+", only) if name and name != FULL]
    for name in (name for name in asked if name not in pipeline.variants):
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


def _mean(evaluate: Path | None, of: str = "mean") -> dict[str, float | None]:
    return json.loads((evaluate / "metrics.json").read_text()).get(of, {}) if evaluate else {}


def show_results(stage: str, folder: Path | None) -> None:
    """Where the results are; after `evaluate` the mean metrics too, those of the initialization beside them."""
    if folder is None:
        return
    if stage == "evaluate":
        initial = _mean(folder, "initialize")
        for name, value in _mean(folder).items():
            before = f" initialization {_number(initial[name])}" if initial.get(name) is not None else ""
            say(f"  {name:<16} {_number(value) or 'not available':<14}{before}")
    names = (p.name + ("/" if p.is_dir() else "") for p in sorted(folder.iterdir()) if p.name != RECEIPT)
    say(f"results in {shown(folder)}/: {', '.join(names)}")


def _number(value: Any) -> str:
    return f"{value:.4f}" if isinstance(value, float) else "" if value is None else str(value)


def batch(request: Request, folder: Path) -> int:
    """Every scene in `folder`, one after another; a table in runs/results.{csv,md}. Returns how many failed."""
    scenes = sorted(p for p in folder.iterdir() if p.is_dir() and p.name[0] not in "._") if folder.is_dir() else []
    if not scenes:
        raise Refused(f"data={folder}: no folders of scenes there")
    rows: dict[str, dict[str, float | None]] = {}
    failed: dict[str, str] = {}
    hashes = Hashes(request.runs / HASHES)
    for scene in scenes:
        stages, error = _tried(replace(request, scene=str(scene)), hashes)
        if error:
            failed[scene.name] = error
        else:
            rows[scene.name] = _mean(stages.get("evaluate"))
    suffix = f"@{request.variant}" if request.variant else ""
    _write_table(request.runs / f"results{suffix}", rows, failed)
    for name, reason in failed.items():
        say(f"failed: {name}: {reason}")
    say(f"{len(rows)} of {len(scenes)} scenes done; table: {shown(request.runs)}/results{suffix}.csv and .md")
    return len(failed)


def _write_table(stem: Path, rows: dict[str, dict[str, float | None]], failed: dict[str, str]) -> None:
    """A row a scene, and the mean over the scenes that have a value."""
    names = list(dict.fromkeys(name for row in rows.values() for name in row))
    lines = [[scene, "done", *(_number(row.get(name)) for name in names)] for scene, row in rows.items()]
    lines += [[scene, "failed", *("" for _ in names)] for scene in failed]
    there = [[row[name] for row in rows.values() if isinstance(row.get(name), int | float)] for name in names]
    lines.append([f"mean of {len(rows)}", "", *(_number(sum(v) / len(v)) if v else "" for v in there)])
    header = ["scene", "state", *names]
    csv.writer(table := io.StringIO(), lineterminator="\n").writerows([header, *lines])
    write_text(Path(f"{stem}.csv"), table.getvalue())
    text = [" | ".join(cells) for cells in (header, ["---"] * len(header), *lines)]
    write_text(Path(f"{stem}.md"), "".join(f"| {line} |\n" for line in text))
