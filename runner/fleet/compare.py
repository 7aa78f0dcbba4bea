"""The commands `compare`, which runs the full method and its variants, and `batch`, which runs all scenes of a folder.

A variant is a baseline or an ablation of pipeline.yaml. A method is a variant, the full method, or the scene's own run,
i.e. the run without a variant. The full method is the variant "full"; if pipeline.yaml has no such variant, it is the
scene's own run.
"""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from reffusion.command import scene_name
from runner import Failed, Refused, say
from runner.execute import Execution
from runner.files import write_json
from runner.fleet.engine import LocalEngine
from runner.fleet.parallel import Outcome, SceneRun, run_all
from runner.keys import HASHES, Hashes
from runner.pipeline import Pipeline, check_known, find_scene, load_pipeline
from runner.process import PROJECT
from runner.resolve import Request, resolve_all
from runner.results import mean_scores
from runner.text import display_path

FULL = "full"  # name of the full method: a variant of this name, or else the scene's own run
OWN = "default"  # name of the scene's own run if FULL is a variant
FOLDER_RUN = "compare"  # folder in runs/ for the comparison over a folder of scenes
RECORD = "compare.json"
RESULTS = "results"  # name in runs/ of the record, table and page of a batch
WAITING, DONE, FAILED = "not run yet", "done", "failed"


def compare(
    request: Request, only: str = "", seeds: int = 1, data: Path | None = None, execution: Execution | None = None
) -> int:
    """Run the full method, the scene's own run and the variants on one or more scenes.

    The scene's own run uses the profile of the scene. All other methods use the profile that `comparisons` of
    pipeline.yaml names for that profile, if any. After each run, compare.json with the mean scores of all runs is
    written to runs/<scene>/ of the first scene, or to runs/compare/ for a folder of scenes. Artifacts that are up to
    date are used, so the same command resumes after a kill. If a run fails, the other runs go on.

    Args:
        request: the scene and its options, without a variant.
        only: names of the methods to run besides the full method, separated by commas or blanks; "default" is the
            scene's own run. Empty for all methods.
        seeds: number of scenes; for the scene X they are X, X-1, X-2 ..., which must exist.
        data: a folder whose scenes are compared; the request must then name no scene, and `seeds` must be 1.
        execution: settings; None for this machine.

    Returns:
        Number of failed runs.

    Raises:
        Refused: a variant, a scene or a parameter is wrong; nothing has run. Parameters are only checked on the first
            scene that can be read. A scene that cannot be read makes its runs fail.
    """
    if request.variant:
        raise Refused(f"variant={request.variant}: compare runs all variants; variants={request.variant} picks some")
    pipeline, execution = load_pipeline(request.root), execution or Execution(LocalEngine())
    names, own = _scenes(request, seeds, data), OWN if FULL in pipeline.variants else FULL
    methods = [FULL, *_choose_methods(only, pipeline, own)]

    def request_for(scene: str, method: str) -> Request:
        return replace(request, scene=scene, variant=None if method == own else method, compared=method != own)

    ordered = sorted(methods, key=lambda method: method != own)  # the scene's own run first, as variants use its stages
    requests = {(scene, method): request_for(scene, method) for scene in names for method in ordered}
    hashes = Hashes(request.runs / HASHES)
    _check_requests(list(names), requests, hashes)
    runs = [{"scene": names[scene], "method": method, "state": WAITING} for scene, method in requests]
    scenes = list(names.values())
    home = request.runs / (FOLDER_RUN if data else scenes[0])
    record = {"scene": home.name, "scenes": scenes, "methods": methods, "runs": runs}
    record |= {"data": str(data.expanduser().resolve())} if data else {}

    def on_end(place: int, outcome: Outcome) -> None:
        folders = {stage: path and os.path.relpath(path, request.runs) for stage, path in outcome.stages.items()}
        run = runs[place]
        run |= {"state": FAILED, "error": outcome.error} if outcome.error else {"state": DONE, "stages": folders}
        run |= {"mean": mean_scores(outcome.stages.get("evaluate"))}
        write_json(home / RECORD, record)

    write_json(home / RECORD, record)
    todo = []
    for number, ((scene, method), each) in enumerate(requests.items(), 1):
        place = request.runs / (names[scene] if method == own else f"{names[scene]}@{method}")
        announcement = f"\ncompare: {method} on {names[scene]}, {number} of {len(runs)}"
        todo.append(SceneRun(place.name, names[scene], place, each, announcement))
    run_all(todo, execution, hashes, list(pipeline.stages), on_end)
    failed = [run for run in runs if run["state"] == FAILED]
    say("")
    for run in failed:
        say(f"failed: {run['method']} on {run['scene']}: {run['error']}")
    say(f"compare: {len(runs) - len(failed)} of {len(runs)} done; {display_path(home / RECORD)} says where")
    return len(failed)


def _check_requests(scenes: list[str], requests: dict[tuple[str, str], Request], hashes: Hashes) -> None:
    """Check each method's parameters on the first scene that resolves, before any run; raises Refused if none does."""
    refusals = []
    for each in scenes:
        try:
            resolve_all([request for (scene, _), request in requests.items() if scene == each], hashes)
            return  # errors of other scenes appear when these scenes run
        except Refused as error:
            refusals.append(error)
    raise refusals[0]


def _choose_methods(only: str, pipeline: Pipeline, own: str) -> list[str]:
    """Return the methods to run besides FULL: those in `only`, else `own` (the scene's own run) and all variants."""
    known = [name for name in dict.fromkeys((own, *pipeline.variants)) if name != FULL]  # FULL always runs
    methods = [name for name in re.split(r"[,\s]+", only) if name and name != FULL]
    for name in methods:
        check_known("variants", "variant", name, known)
    return list(dict.fromkeys(methods)) if only else known


def _scenes(request: Request, seeds: int, data: Path | None) -> dict[str, str]:
    """Return the scenes of `compare` (name or path that a request uses -> name); raises Refused if one is missing."""
    if seeds < 1:
        raise Refused(f"seeds={seeds}: seeds must be at least 1; it is the number of scenes")
    if data:
        if request.scene or seeds > 1:
            raise Refused(f"data={data}: all scenes of a folder, without scene={request.scene} and seeds={seeds}")
        return {str(folder): folder.name for folder in _scene_folders(data)}
    scenes = [request.scene, *(f"{request.scene.rstrip('/')}-{seed}" for seed in range(1, seeds))]
    names = {scenes[0]: scene_name(find_scene(scenes[0], request.root))}
    for scene in scenes[1:]:
        try:
            names[scene] = scene_name(find_scene(scene, request.root))
        except Refused as error:
            raise Refused(f"seeds={seeds} asks for the scenes {scenes[0]} to {scenes[-1]}: {error}") from None
    return names


def _scene_folders(data: Path) -> list[Path]:
    """Return the subfolders of a folder without a leading "." or "_", sorted; raises Refused if there are none."""
    data = data.expanduser()
    found = sorted(p for p in data.iterdir() if p.is_dir() and p.name[0] not in "._") if data.is_dir() else []
    if not found:
        raise Refused(f"data={data}: no folders of scenes there")
    return found


def batch(request: Request, folder: Path, execution: Execution | None = None) -> int:
    """Run all scenes of a folder, and write runs/results.json and a table after each one.

    With a variant, the files are named results@<variant>. If a scene fails, the others go on.

    Args:
        request: the options; its scene is not used.
        folder: the folder of scenes.
        execution: settings; None for this machine.

    Returns:
        Number of failed scenes.

    Raises:
        Refused: the folder has no scenes.
    """
    scenes, hashes = _scene_folders(folder), Hashes(request.runs / HASHES)
    execution = execution or Execution(LocalEngine())
    suffix = f"@{request.variant}" if request.variant else ""
    record = request.runs / f"{RESULTS}{suffix}.json"
    runs: list[dict[str, Any]] = [{"scene": scene.name, "state": WAITING} for scene in scenes]

    def on_end(place: int, outcome: Outcome) -> None:
        run = runs[place]
        run |= {"state": FAILED, "error": outcome.error} if outcome.error else {"state": DONE}
        run |= {"home": f"{run['scene']}{suffix}", "seconds": round(outcome.seconds, 1)}
        run |= {"mean": mean_scores(outcome.stages.get("evaluate"))}
        write_json(record, {"data": str(folder), "runs": runs})
        write_table(record)

    homes = [request.runs / f"{scene.name}{suffix}" for scene in scenes]
    todo = [
        SceneRun(scene.name, scene.name, home, replace(request, scene=str(scene)))
        for scene, home in zip(scenes, homes, strict=True)
    ]
    run_all(todo, execution, hashes, list(load_pipeline(request.root).stages), on_end)
    failed = [run for run in runs if run["state"] == FAILED]
    for run in failed:
        say(f"failed: {run['scene']}: {run['error']}")
    table = display_path(record.with_suffix(""))
    say(f"{len(runs) - len(failed)} of {len(runs)} scenes done; table: {table}.csv and .md")
    return len(failed)


def write_table(record: Path) -> None:
    """Run report/table.py, which writes the table of a batch to the folder of its record.

    Args:
        record: the JSON file with the record.

    Raises:
        Failed: the table could not be written.
    """
    if call_report("table", str(record)):
        raise Failed(f"the table of {display_path(record)} could not be written (see above)")


def call_report(module: str, *arguments: str) -> int:
    """Run `python -m report.<module>` with these arguments, and return its exit code."""
    path = os.pathsep.join(filter(None, [str(PROJECT), os.environ.get("PYTHONPATH", "")]))
    command = [sys.executable, "-m", f"report.{module}", *arguments]
    return subprocess.run(command, env={**os.environ, "PYTHONPATH": path}).returncode
