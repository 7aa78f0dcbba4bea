"""A request with everything about it resolved and checked: scene, profile, variant, parameters of all stages."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runner.budget import seconds_of, shared_out
from runner.keys import Hashes
from runner.pipeline import (
    SCENE,
    Layers,
    Overrides,
    Pipeline,
    Refused,
    choose_profile,
    find_scene,
    layered,
    load_pipeline,
    load_scene_file,
    parse_set,
    unknown,
)


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
    budget: str | None = None


@dataclass(frozen=True)
class Job:
    """One scene with everything about it resolved and checked.

    Attributes:
        home: runs/<scene>, or runs/<scene>@<variant>.
        base: runs/<scene>.
        why: what made the choice of the profile.
        brings: the keys of scene.yaml that have values.
        reads: stage -> the files of the scene that it reads; stages that do not tell (they read all) are left out.
        params: stage -> every parameter.
        broken: stages without parameters here, because their file is missing or is no stage -> what is wrong.
        weights: stage -> names of the parameters that name weights.
        needed: stage -> the weights it works with, as it says of itself (reffusion.weights.local.Need).
    """

    root: Path
    runs: Path
    folder: Path
    name: str
    home: Path
    base: Path
    pipeline: Pipeline
    profile: str
    why: str
    trust: bool
    brings: frozenset[str]
    params: Overrides
    broken: dict[str, str]
    weights: dict[str, tuple[str, ...]]
    needed: dict[str, list[dict[str, Any]]]
    reads: dict[str, tuple[Path, ...]]
    hashes: Hashes

    @property
    def label(self) -> str:
        return self.home.name


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
    profile, why = choose_profile(request.profile, scene, [home / "profile", base / "profile"], pipeline)
    given = (pipeline, scene, profile, request.variant, parse_set(request.set, pipeline))
    layers = layered(*given, {})
    if request.budget or scene.budget is not None:
        origin, text = ("budget", request.budget) if request.budget else (str(scene.path), scene.budget)
        layers = layered(*given, shared_out(pipeline, layers.values, seconds_of(text, origin)))
    described, broken = described_stages(root, pipeline, layers, brought(scene.brings, folder), folder)
    params = {name: answer["params"] for name, answer in described.items()}
    return Job(
        root=root,
        runs=runs,
        folder=folder,
        name=folder.name,
        home=home,
        base=base,
        pipeline=pipeline,
        profile=profile,
        why=why,
        trust=request.trust,
        brings=frozenset(scene.brings),
        params=params,
        broken=broken,
        weights={name: tuple(answer["weights"]) for name, answer in described.items()},
        needed={name: answer["needed"] for name, answer in described.items()},
        reads={name: tuple(map(Path, of)) for name, a in described.items() if (of := a["reads"]) is not None},
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


def brought(keys: Iterable[str], folder: Path) -> list[str]:
    """What a scene brings of itself: the keys of its scene.yaml, and the names of its folders."""
    return sorted({*keys, *(path.name for path in folder.iterdir() if path.is_dir())})


def outside(value: Any, folder: Path) -> Iterator[Path]:
    """Files and folders named anywhere in `value`, relative to the scene, that the scene's folder does not hold."""
    if isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from outside(part, folder)
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


def ask(root: Path, question: dict[str, Any]) -> dict[str, Any]:
    """What stages say of themselves: see `runner.child.describe`."""
    process = child(root, "describe", stdout=subprocess.PIPE)
    answer, _ = process.communicate(json.dumps(question))
    if process.returncode:
        raise Refused("the stages could not be asked for their parameters (see above)")
    return json.loads(answer)


def described_stages(
    root: Path, pipeline: Pipeline, layers: Layers, brings: list[str], scene: Path | None = None
) -> tuple[dict[str, Any], dict[str, str]]:
    """stage -> `child._describe` of it, and broken stages; refuses the first wrong parameter."""
    broken = {name: f"stages/{name}.py: no such file, and pipeline.yaml names it" for name in pipeline.stages}
    here = [name for name in pipeline.stages if (root / "stages" / f"{name}.py").is_file()]
    questions = {
        name: {
            "params": layers.values[name],
            "takes": pipeline.stages[name].takes,
            "brings": brings,
            "scene": str(scene) if scene and SCENE in pipeline.stages[name].takes else None,
        }
        for name in here
    }
    described = {}
    for stage, answer in ask(root, questions).items():
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
