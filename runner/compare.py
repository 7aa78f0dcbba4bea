"""Many runs: `compare`, the full method and every variant on a scene or several; `batch`, every scene of a folder."""

import csv
import io
import json
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from reffusion.command import installed, workplace
from runner import Refused, say
from runner.engine import Engine, Local
from runner.files import RECEIPT, shown, write_json, write_text
from runner.keys import HASHES, Hashes
from runner.parallel import Outcome, Run, do_all
from runner.pipeline import Pipeline, find_scene, load_pipeline, scene_name, unknown
from runner.resolve import Request, resolve_all

FULL = "full"  # the whole method: a variant of this name, else the scene's own run
OWN = "default"  # the scene's own run, where FULL is a variant
TOGETHER = "compare"  # the folder in runs/ of a comparison over a folder of scenes
RECORD = "compare.json"
RUNS = "compare-runs"  # .csv and .md: a row a run, written anew after each
SCENE_FILE = "scene.ply"  # of the stage `evaluate`
RESULTS = "results"  # .json, .csv and .md of a batch
WAITING, DONE, FAILED = "not run yet", "done", "failed"


@dataclass(frozen=True)
class By:
    """Who does the work, with how many cores a stage (None: an equal part for each scene)."""

    engine: Engine
    cores: int | None = None


def compare(request: Request, only: str = "", seeds: int = 1, data: Path | None = None, by: By | None = None) -> int:
    """Bring the full method and the variants up to date, in the profile of pipeline.yaml's `comparisons`, and write
    compare.json to runs/<scene>/, of a folder of scenes to runs/compare/; how many failed.

    What is cached is not run again, so the same command goes on after a kill; after each run all that is done is a
    table, compare-runs.csv and .md. A variant that fails stops no other.
    `only` names variants, with commas or blanks between (all where empty); `seeds` counts scenes: X, X-1, X-2 ...;
    `data` is a folder whose scenes are compared, where the request names none.
    Raises Refused before any work, where a variant, a scene or a parameter is not right."""
    if request.variant:
        raise Refused(f"variant={request.variant}: compare runs all variants; variants={request.variant} picks some")
    pipeline, by = load_pipeline(request.root), by or By(Local())
    names, own = _scenes(request, seeds, data), OWN if FULL in pipeline.variants else FULL
    methods = [FULL, *_chosen(only, pipeline, own)]

    def asks(scene: str, method: str) -> Request:
        return replace(request, scene=scene, variant=None if method == own else method, compared=method != own)

    in_turn = sorted(methods, key=lambda method: method != own)  # the scene's own run first: variants share its stages
    requests = {(scene, method): asks(scene, method) for scene in names for method in in_turn}
    hashes = Hashes(request.runs / HASHES)
    _refuse_wrong(list(names), requests, hashes)
    runs = [{"scene": names[scene], "method": method, "state": WAITING} for scene, method in requests]
    scenes = list(names.values())
    home = request.runs / (TOGETHER if data else scenes[0])
    record = {"scene": home.name, "scenes": scenes, "methods": methods, "runs": runs}
    record |= {"data": str(data.expanduser().resolve())} if data else {}

    def ended(place: int, outcome: Outcome) -> None:
        where = {stage: path and os.path.relpath(path, request.runs) for stage, path in outcome.stages.items()}
        run = runs[place]
        run |= {"state": FAILED, "error": outcome.error} if outcome.error else {"state": DONE, "stages": where}
        run |= {"mean": _mean(outcome.stages.get("evaluate"))}
        _write_table(home / RUNS, runs, ("method", "scene"))
        write_json(home / RECORD, record)

    write_json(home / RECORD, record)
    todo = []
    for number, ((scene, method), asked) in enumerate(requests.items(), 1):
        place = request.runs / (names[scene] if method == own else f"{names[scene]}@{method}")
        announced = f"\ncompare: {method} on {names[scene]}, {number} of {len(runs)}"
        todo.append(Run(place.name, names[scene], place, asked, announced))
    do_all(todo, by.engine, by.cores, hashes, list(pipeline.stages), ended)
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


def _chosen(only: str, pipeline: Pipeline, own: str) -> list[str]:
    """The methods beside FULL: those that `only` names, else the scene's own run and all variants."""
    known = [name for name in dict.fromkeys((own, *pipeline.variants)) if name != FULL]
    asked = [name for name in re.split(r"[,\s]+", only) if name and name != FULL]
    for name in (name for name in asked if name not in known):
        raise Refused(f"variants: {unknown('variant', name, known)}")
    return list(dict.fromkeys(asked)) if only else known


def _scenes(request: Request, seeds: int, data: Path | None) -> dict[str, str]:
    """What a request names each scene by -> the scene's own name."""
    if seeds < 1:
        raise Refused(f"seeds={seeds}: on how many scenes; 1 or more")
    if data:
        if request.scene or seeds > 1:
            raise Refused(f"data={data}: all scenes of a folder, without scene={request.scene} and seeds={seeds}")
        return {str(folder): folder.name for folder in _folders(data)}
    scenes = [request.scene, *(f"{request.scene.rstrip('/')}-{seed}" for seed in range(1, seeds))]
    names = {scenes[0]: scene_name(find_scene(scenes[0], request.root))}
    for scene in scenes[1:]:
        try:
            names[scene] = scene_name(find_scene(scene, request.root))
        except Refused as error:
            raise Refused(f"seeds={seeds} asks for the scenes {scenes[0]} to {scenes[-1]}: {error}") from None
    return names


def _folders(data: Path) -> list[Path]:
    """The folders of scenes in a folder. Raises Refused where there are none."""
    data = data.expanduser()
    found = sorted(p for p in data.iterdir() if p.is_dir() and p.name[0] not in "._") if data.is_dir() else []
    if not found:
        raise Refused(f"data={data}: no folders of scenes there")
    return found


def _mean(evaluate: Path | None, of: str = "mean") -> dict[str, float | None]:
    return json.loads((evaluate / "metrics.json").read_text()).get(of, {}) if evaluate else {}


def show_results(stage: str, folder: Path | None, request: Request) -> None:
    """Where the results are; after `evaluate` the mean scores too, those of the initialization beside them, and what to
    open."""
    if folder is None:
        return
    if stage == "evaluate":
        initial, scores = _mean(folder, "initialize"), {n: v for n, v in _mean(folder).items() if v is not None}
        for name, value in scores.items():
            before = f" initialization {_number(initial[name])}" if initial.get(name) is not None else ""
            say(f"  {name:<16} {_number(value):<14}{before}")
        if not scores:
            say("  no scores: no test view shows the scene without the object (`test` in scene.yaml)")
    names = (p.name + ("/" if p.is_dir() else "") for p in sorted(folder.iterdir()) if p.name != RECEIPT)
    say(f"results in {shown(folder)}/: {', '.join(names)}")
    if stage == "evaluate" and (folder / SCENE_FILE).is_file():
        say(f"open {shown(folder / SCENE_FILE)} in any viewer of 3D Gaussian splats, or here:")
        say(f"  {make_command(request, 'view')}    {make_command(request, 'report')}")


def make_command(request: Request, command: str) -> str:
    """What people type for another command on the same scene and results: make in a checkout, which installs what the
    command needs, else `reffusion`."""
    runs = "" if request.runs == workplace(request.root) / "runs" else shown(request.runs)
    options = {"scene": request.scene, "variant": request.variant, "runs": runs}
    if installed(request.root):
        return f"reffusion {command} " + " ".join(f"--{name} {value}" for name, value in options.items() if value)
    return "make " + " ".join(f"{name}={value}" for name, value in options.items() if value) + f" {command}"


def _number(value: Any) -> str:
    return f"{value:.4f}" if isinstance(value, float) else "" if value is None else str(value)


def batch(request: Request, folder: Path, by: By | None = None) -> int:
    """Every scene in `folder`; runs/results.json, and a table in results.csv and .md, written anew after each, that
    with the reasons of those that failed. Returns how many failed."""
    scenes, hashes, by = _folders(folder), Hashes(request.runs / HASHES), by or By(Local())
    end = f"@{request.variant}" if request.variant else ""
    stem = request.runs / f"{RESULTS}{end}"
    runs: list[dict[str, Any]] = [{"scene": scene.name, "method": "", "state": WAITING} for scene in scenes]

    def ended(place: int, outcome: Outcome) -> None:
        run = runs[place]
        run |= {"state": FAILED, "error": outcome.error} if outcome.error else {"state": DONE}
        run |= {"home": f"{run['scene']}{end}", "seconds": round(outcome.seconds, 1)}
        run |= {"mean": _mean(outcome.stages.get("evaluate"))}
        _write_table(stem, runs, ("scene",))
        write_json(Path(f"{stem}.json"), {"data": str(folder), "runs": runs})

    asks = lambda scene: replace(request, scene=str(scene))
    homes = [request.runs / f"{scene.name}{end}" for scene in scenes]
    todo = [Run(scene.name, scene.name, home, asks(scene)) for scene, home in zip(scenes, homes, strict=True)]
    do_all(todo, by.engine, by.cores, hashes, list(load_pipeline(request.root).stages), ended)
    failed = [run for run in runs if run["state"] == FAILED]
    for run in failed:
        say(f"failed: {run['scene']}: {run['error']}")
    say(f"{len(runs) - len(failed)} of {len(runs)} scenes done; table: {shown(stem)}.csv and .md")
    return len(failed)


def _write_table(stem: Path, runs: list[dict[str, Any]], keys: tuple[str, ...]) -> None:
    """A row a run, and for each method the mean over the scenes that have a value. `keys`: the columns that name it."""
    names = list(dict.fromkeys(name for run in runs for name in run.get("mean", {})))
    lines = [[*(run[key] for key in keys), run["state"], *_numbers(run.get("mean", {}), names)] for run in runs]
    for method in dict.fromkeys(run["method"] for run in runs):
        done = [run["mean"] for run in runs if run["method"] == method and run["state"] == DONE]
        there = {name: [mean[name] for mean in done if isinstance(mean.get(name), int | float)] for name in names}
        means = {name: sum(values) / len(values) for name, values in there.items() if values}
        lines.append([*([method] if len(keys) > 1 else []), f"mean of {len(done)}", "", *_numbers(means, names)])
    header = [*keys, "state", *names]
    csv.writer(table := io.StringIO(), lineterminator="\n").writerows([header, *lines])
    write_text(Path(f"{stem}.csv"), table.getvalue())
    text = [" | ".join(cells) for cells in (header, ["---"] * len(header), *lines)]
    failed = [] if len(keys) > 1 else [run for run in runs if run["state"] == FAILED]
    said = "".join(f"- {run['scene']} failed: {run['error']}\n" for run in failed) + "\n" * bool(failed)
    write_text(Path(f"{stem}.md"), said + "".join(f"| {line} |\n" for line in text))


def _numbers(mean: dict[str, Any], names: list[str]) -> list[str]:
    return [_number(mean.get(name)) for name in names]
