"""One word and a reason for each stage, from what lies on the disk; nothing heavy is imported."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from runner.keys import Hashes, Inputs, changes, code_changes, code_of, files_below
from runner.pipeline import (
    SCENE,
    Condition,
    Layers,
    Overrides,
    Pipeline,
    Refused,
    choose_profile,
    find_scene,
    has_cuda,
    layered,
    load_pipeline,
    load_scene_file,
    parse_set,
    unknown,
)

RECEIPT = "receipt.json"
MACHINE = platform.node()


@dataclass(frozen=True)
class Request:
    """What the command line asks for. Texts are as given; None where not given."""

    root: Path
    runs: Path
    scene: str
    profile: str | None = None
    variant: str | None = None
    trust: bool = False
    set: str = ""


@dataclass(frozen=True)
class Job:
    """One scene with everything about it resolved and checked.

    Attributes:
        home: runs/<scene>, or runs/<scene>@<variant>.
        base: runs/<scene>.
        brings: the keys of scene.yaml that have values.
        params: stage -> every parameter.
        broken: stages without parameters here, because their file is missing or is no stage -> what is wrong.
        weights: stage -> names of the parameters that name weights.
        outside: files or folders named by the scene's parameters that lie outside its folder.
    """

    root: Path
    runs: Path
    folder: Path
    name: str
    home: Path
    base: Path
    pipeline: Pipeline
    profile: str
    trust: bool
    brings: frozenset[str]
    params: Overrides
    broken: dict[str, str]
    weights: dict[str, tuple[str, ...]]
    outside: tuple[Path, ...]
    hashes: Hashes

    @property
    def label(self) -> str:
        return self.home.name


@dataclass(frozen=True)
class Decision:
    """The word for a stage.

    Attributes:
        word: run, cached, provided, skip, missing, stale or undecided.
        reason: why, in words.
        path: the artifact's folder as it stands; None where there is none or the stage is left out.
        settled: True where this artifact (or its absence) is final.
        inputs: what the artifact depends on, where that is known.
        notes: what the stage says of itself beforehand.
    """

    word: str
    reason: str
    path: Path | None = None
    settled: bool = False
    inputs: Inputs | None = None
    notes: tuple[str, ...] = ()


# ---------------------------------------------------------------------------------------------- from request to job


def prepare(request: Request) -> Job:
    """Read and check everything a request names. Raises Refused with one line that says what would fix it."""
    root, runs = request.root, request.runs
    pipeline = load_pipeline(root)
    folder = find_scene(request.scene, root)
    scene = load_scene_file(folder, pipeline)
    if request.variant and request.variant not in pipeline.variants:
        raise Refused(f"{root / 'pipeline.yaml'}: {unknown('variant', request.variant, pipeline.variants)}")
    base = runs / folder.name
    home = runs / (f"{folder.name}@{request.variant}" if request.variant else folder.name)
    _one_folder_a_name(base, folder, root)
    profile = choose_profile(request.profile, scene, [home / "profile", base / "profile"], pipeline)
    layers = layered(pipeline, scene, profile, request.variant, parse_set(request.set, pipeline))
    described, broken = _described(root, pipeline, layers)
    params = {name: answer["params"] for name, answer in described.items()}
    scene_params = [params[stage] for stage in pipeline.scene_keys if stage in params]
    return Job(
        root=root,
        runs=runs,
        folder=folder,
        name=folder.name,
        home=home,
        base=base,
        pipeline=pipeline,
        profile=profile,
        trust=request.trust,
        brings=frozenset(scene.brings),
        params=params,
        broken=broken,
        weights={name: tuple(answer["weights"]) for name, answer in described.items()},
        outside=tuple(_outside(scene_params, folder)),
        hashes=Hashes(runs / ".hashes.json"),
    )


def source_of(folder: Path, root: Path) -> str:
    """How runs/<scene>/source names a scene's folder: from the root where it lies inside."""
    return folder.relative_to(root).as_posix() if folder.is_relative_to(root) else str(folder)


def _one_folder_a_name(base: Path, folder: Path, root: Path) -> None:
    record = base / "source"
    if record.is_file():
        before = root / record.read_text().strip()
        if before != folder and before.is_dir():
            raise Refused(
                f"two scenes are called {folder.name!r}: {base} was made from {before}, and {folder} is asked for; "
                f"rename one folder, or make room with `make scene={before} clean`"
            )


def _outside(value: Any, folder: Path) -> Iterator[Path]:
    """Files and folders named anywhere in `value`, relative to the scene, that the scene's folder does not hold."""
    if isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _outside(part, folder)
    elif isinstance(value, str) and value and "\0" not in value and len(value) < 1024:
        path = (folder / value).resolve()
        if ("/" in value or os.sep in value) and not path.is_relative_to(folder) and path.exists():
            yield path


def child(root: Path, *arguments: str, **options: Any) -> subprocess.Popen[str]:
    """A fresh process that may import stages: `python -m runner.child <arguments>` with `root` first on its path."""
    here = Path(__file__).resolve().parent.parent
    path = os.pathsep.join(filter(None, [str(root), str(here), os.environ.get("PYTHONPATH", "")]))
    command = [sys.executable, "-m", "runner.child", *arguments]
    return subprocess.Popen(
        command, cwd=root, env={**os.environ, "PYTHONPATH": path}, stdin=subprocess.PIPE, text=True, **options
    )


def _ask(root: Path, question: dict[str, Any]) -> dict[str, Any]:
    process = child(root, "describe", stdout=subprocess.PIPE)
    answer, _ = process.communicate(json.dumps(question))
    if process.returncode:
        raise Refused("the stages could not be asked for their parameters (see above)")
    return json.loads(answer)


def _described(root: Path, pipeline: Pipeline, layers: Layers) -> tuple[dict[str, Any], dict[str, str]]:
    """stage -> {"params": all parameters, "weights": names}, and broken stages; refuses the first wrong parameter."""
    broken = {name: f"stages/{name}.py: no such file, and pipeline.yaml names it" for name in pipeline.stages}
    here = [name for name in pipeline.stages if (root / "stages" / f"{name}.py").is_file()]
    questions = {name: {"params": layers.values[name], "takes": pipeline.stages[name].takes} for name in here}
    described = {}
    for stage, answer in _ask(root, questions).items():
        if answer["broken"]:
            broken[stage] = answer["broken"]
            continue
        for error in answer["errors"]:
            name, origin = error["param"], layers.origin[stage].get(error["param"], "pipeline.yaml")
            if error["unknown"]:
                raise Refused(f"{origin}: stage {stage}: {unknown('parameter', name, answer['known'])}")
            raise Refused(f"{origin}: {stage}.{error['where']} = {error['value']}: {error['message']}")
        described[stage] = answer
    return described, {name: why for name, why in broken.items() if name not in described}


# ------------------------------------------------------------------------------------------------------- the words


def receipt(folder: Path) -> dict[str, Any] | None:
    try:
        return json.loads((folder / RECEIPT).read_text())
    except (OSError, ValueError):
        return None


def decide(job: Job, stage: str, earlier: dict[str, Decision]) -> Decision:
    """The word for `stage`, given those of the stages before it."""
    spec = job.pipeline.stages[stage]
    if stage in job.broken:
        raise Refused(job.broken[stage])
    if spec.provided and spec.provided.by in job.brings:
        source = earlier[spec.provided.artifact]
        return Decision("provided", f"the scene brings `{spec.provided.by}`", source.path, source.settled)
    unknown_yet = []
    for condition in spec.left_out:
        if holds := _holds(job, condition, earlier):
            return Decision("skip", condition.because, settled=True)
        if holds is None:
            unknown_yet.append(f"left out if {condition.because}: known after {condition.names[0]}")
    needs = {need: earlier[need] for need in spec.takes if need != SCENE}
    for need in (need for need in spec.needs if need != SCENE):
        if needs[need].word == "skip":
            return Decision("skip", f"needs {need}, which is left out", settled=True)
        if needs[need].word == "undecided":
            unknown_yet.append(f"waits for {need}")
    if lost := _missing_weights(job, stage):
        return Decision("missing", lost)
    code = code_of(job.root, stage, job.hashes)
    if unknown_yet:
        return Decision("undecided", unknown_yet[0], _there(job, stage))
    moving = [need for need, decision in needs.items() if not decision.settled]
    if moving:
        path = _there(job, stage)
        found = path and receipt(path)
        if not found:
            return Decision("run", "no artifact yet")
        as_then = Inputs(job.params[stage], job.profile, found["needs"], found["weights"], code)
        if known := [] if job.trust else changes(found, as_then):
            return Decision("run", _listed(known), path)
        return Decision("stale", f"waits for {', '.join(moving)}; kept if the new content is the same", path)
    return _compare(job, stage, _inputs(job, stage, {need: d.path for need, d in needs.items()}, code))


def _holds(job: Job, condition: Condition, earlier: dict[str, Decision]) -> bool | None:
    """Is the condition true? None: not known yet."""
    stage, name = condition.names
    if condition.unless and condition.unless in job.brings:
        return False
    if condition.param:
        if name not in job.params.get(stage, {}):
            raise Refused(f"{job.root / 'pipeline.yaml'}: a condition asks for {condition.param}, which is not there")
        return job.params[stage][name] == condition.equals
    source = earlier[stage]
    if source.word == "skip":
        return False
    if not source.settled or source.path is None:
        return None
    if condition.empty:
        return not any(files_below(source.path / name))
    try:
        return json.loads((source.path / "facts.json").read_text())[name] == condition.equals
    except (OSError, ValueError, KeyError):
        raise Refused(f"{source.path / 'facts.json'}: has no {name!r}, which pipeline.yaml asks for") from None


def _there(job: Job, stage: str) -> Path | None:
    return next((home / stage for home in (job.home, job.base) if (home / stage / RECEIPT).is_file()), None)


def _weights_folder(job: Job, name: str) -> Path | None:
    """The local folder that a weights parameter names, or None for the id of published weights."""
    path = job.root / Path(name).expanduser()
    local = path.exists() or name.startswith(("/", ".", "~")) or name.count("/") != 1
    return path if local or (job.root / name.split("/")[0]).is_dir() else None


def _missing_weights(job: Job, stage: str) -> str | None:
    for param in job.weights[stage]:
        name = job.params[stage][param]
        folder = _weights_folder(job, name) if name else None
        if folder and not folder.exists():
            return f"{stage}.{param}: no weights at {folder}; name a folder, or an id such as owner/model"
    return None


def _inputs(job: Job, stage: str, needs: dict[str, Path | None], code: dict[str, str]) -> Inputs:
    hashes = {need: path and job.hashes.folder(path) for need, path in needs.items()}
    if SCENE in job.pipeline.stages[stage].takes:
        hashes[SCENE] = job.hashes.folder(job.folder, leave_out=("scene.yaml",))
        for path in job.outside:
            hashes[str(path)] = job.hashes.folder(path) if path.is_dir() else job.hashes.file(path)
    weights = {}
    for param in job.weights[stage]:
        if name := job.params[stage][param]:
            folder = _weights_folder(job, name)
            weights[param] = job.hashes.folder(folder) if folder else name
    return Inputs(job.params[stage], job.profile, hashes, weights, code)


def _compare(job: Job, stage: str, inputs: Inputs) -> Decision:
    """Cached where a receipt has this key (the variant's own, else the base's); else run, and why."""
    places = [home / stage for home in dict.fromkeys((job.home, job.base))]
    receipts = [(place, found) for place in places if (found := receipt(place))]
    for place, found in receipts:
        if found["key"] == inputs.key:
            said = [] if place.parent == job.home else [f"shared with {job.name}"]
            if job.hashes.folder(place) != found["output"]:
                said.append("its files were changed by hand since")
            return Decision("cached", "; ".join(said), place, True, inputs)
    for place, found in receipts:
        only_code = changes(found, inputs) == code_changes(found, inputs)
        if job.trust and only_code:
            said = f"trusted although {_listed(code_changes(found, inputs))}"
            return Decision("cached", said, place, True, inputs)
    begun = "; goes on where it stopped" if partial_folder(job, stage, inputs.key).exists() else ""
    why = _listed(changes(receipts[0][1], inputs)) if receipts else "no artifact yet"
    return Decision("run", why + begun, places[0] if receipts else None, False, inputs)


def _on_this_machine(job: Job, stage: str, decision: Decision) -> Decision:
    """The decision, or `missing` for work on a GPU where there is none; what is cached holds on any machine."""
    at_work = decision.word in ("run", "stale", "undecided")
    if at_work and job.params[stage].get("device") == "cuda" and not has_cuda():
        cure = f'profile=laptop, or set="{stage}.device=cpu"'
        return Decision("missing", f"{stage}.device is cuda, and this machine has no CUDA driver: {cure}")
    return decision


def partial_folder(job: Job, stage: str, key: str) -> Path:
    return job.home / f".partial-{stage}-{key}"


def _listed(said: list[str], most: int = 3) -> str:
    rest = f" and {len(said) - most} more" if len(said) > most else ""
    return ", ".join(said[:most]) + rest


# -------------------------------------------------------------------------------------------------------- the plan


def plan(job: Job, stages: list[str], done: dict[str, Decision] | None = None) -> dict[str, Decision]:
    """The words for `stages`, in order; `done` holds those already settled. Asks the stages for their notes."""
    decisions = dict(done or {})
    for stage in stages:
        if stage not in decisions:
            decisions[stage] = _on_this_machine(job, stage, decide(job, stage, decisions))
    asked = {}
    for stage in stages:
        spec = job.pipeline.stages[stage]
        needs = {need: job.folder if need == SCENE else decisions[need].path for need in spec.takes}
        if decisions[stage].word in ("run", "stale", "undecided") and all(needs[need] for need in spec.needs):
            paths = {need: path and str(path) for need, path in needs.items()}
            asked[stage] = {"params": job.params[stage], "takes": spec.takes, "needs": paths}
    for stage, answer in (_ask(job.root, asked) if asked else {}).items():
        decisions[stage] = replace(decisions[stage], notes=tuple(answer["notes"]))
        if answer["refusal"] and decisions[stage].inputs:  # its needs are what they will be
            decisions[stage] = replace(decisions[stage], word="missing", reason=answer["refusal"])
    job.hashes.save()
    return {stage: decisions[stage] for stage in stages}


def table(job: Job, decisions: dict[str, Decision]) -> str:
    """A line a stage: word, stage, expected time, reason and notes."""
    lines = [f"{job.label} ({job.profile})"]
    for stage, decision in decisions.items():
        seconds = expected_seconds(job, stage) if decision.word in ("run", "stale", "undecided") else None
        time = f"~{seconds:.0f} s" if seconds is not None else ""
        lines.append(f"  {decision.word:<9} {stage:<12} {time:>7}  {decision.reason}".rstrip())
        lines += [f"{'':33}{note}" for note in decision.notes]
    return "\n".join(lines)


def expected_seconds(job: Job, stage: str) -> float | None:
    """What the stage last took for this scene, or a variant of it, on this machine with this profile."""
    places = [job.runs / job.name, *job.runs.glob(f"{job.name}@*")]
    found = [r for place in places if (r := receipt(place / stage))]
    here = [r for r in found if r["machine"] == MACHINE and r["profile"] == job.profile]
    return max(here, key=lambda r: r["date"])["seconds"] if here else None


def shown(path: Path) -> str:
    """A path as people type it: from the current folder where it lies below."""
    return os.path.relpath(path) if path.is_relative_to(Path.cwd()) else str(path)
