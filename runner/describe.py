"""What stages say of themselves: asked of a process that imports them (child.py), so that this one stays light."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runner import Refused
from runner.layers import Layers
from runner.pipeline import SCENE, Pipeline, read_yaml, unknown

RENAMED = Path("runner", "renamed.yaml")  # old dotted name of a parameter: the new one, or what became of it


@dataclass(frozen=True)
class Described:
    """A stage's own words.

    Attributes:
        params: every parameter, groups nested.
        weights: dotted names of the parameters that name weights.
        unkeyed: dotted names of the parameters that change nothing in the artifact.
        needed: the weights it works with (reffusion.weights.Need).
        reads: the files of the scene that it reads; None for all of them.
        notes: what it has to say beforehand, where it was asked for a preview.
        refusal: why it could not do its work, by that preview.
    """

    params: dict[str, Any]
    weights: tuple[str, ...] = ()
    unkeyed: tuple[str, ...] = ()
    needed: tuple[dict[str, Any], ...] = ()
    reads: tuple[str, ...] | None = None
    notes: tuple[str, ...] = ()
    refusal: str | None = None


def child(root: Path, *arguments: str, **options: Any) -> subprocess.Popen[str]:
    """A fresh process that may import stages: `python -m runner.child <arguments>` with `root` first on its path."""
    here = Path(__file__).resolve().parent.parent
    path = os.pathsep.join(filter(None, [str(root), str(here), os.environ.get("PYTHONPATH", "")]))
    command, environment = [sys.executable, "-m", "runner.child", *arguments], {**os.environ, "PYTHONPATH": path}
    return subprocess.Popen(command, cwd=root, env=environment, stdin=subprocess.PIPE, text=True, **options)


def ask(root: Path, questions: Iterable[dict[str, Any]], answers: dict[str, Any] | None = None) -> list[dict[str, Any]]:
    """The answer to each: see `child.describe`. What is in `answers` already is not asked again; what is new joins."""
    answers = {} if answers is None else answers
    names = [json.dumps(question) for question in questions]
    if new := [name for name in dict.fromkeys(names) if name not in answers]:
        process = child(root, "describe", stdout=subprocess.PIPE)
        said, _ = process.communicate(f"[{','.join(new)}]")
        if process.returncode:
            raise Refused("the stages could not be asked for their parameters (see above)")
        answers.update(zip(new, json.loads(said), strict=True))
    return [answers[name] for name in names]


def questions(
    root: Path, pipeline: Pipeline, layers: Layers, brings: list[str], scene: Path | None = None
) -> list[dict[str, Any]]:
    """What to ask of the stages that have a file, given what was asked for and what the scene brings."""
    return [
        {
            "stage": name,
            "params": layers.values[name],
            "takes": spec.takes,
            "brings": brings,
            "scene": str(scene) if scene and SCENE in spec.takes else None,
        }
        for name, spec in pipeline.stages.items()
        if (root / "stages" / f"{name}.py").is_file()
    ]


def described(
    root: Path, pipeline: Pipeline, layers: Layers, asked: list[dict[str, Any]], answers: dict[str, Any] | None = None
) -> tuple[dict[str, Described], dict[str, str]]:
    """stage -> its words; broken stage -> why. Raises Refused for the first parameter that is wrong."""
    broken = {name: f"stages/{name}.py: no such file, and pipeline.yaml names it" for name in pipeline.stages}
    stages = {}
    for stage, answer in zip([each["stage"] for each in asked], ask(root, asked, answers), strict=True):
        if "broken" in answer:
            broken[stage] = answer["broken"]
            continue
        for error in answer.get("errors", ()):
            raise Refused(_refusal(root, stage, error, answer["known"], layers.origin(stage, error["where"])))
        stages[stage] = Described(**answer)
        del broken[stage]
    return stages, broken


def _refusal(root: Path, stage: str, error: dict[str, Any], known: list[str], origin: str) -> str:
    name = error["where"]
    if not error["unknown"]:
        return f"{origin}: {stage}.{name} = {error['value']}: {error['message']}"
    path = root / RENAMED
    new_names = read_yaml(path) if path.is_file() else {}
    old = f"{stage}.{name}"
    while old and old not in new_names:
        old = old.rpartition(".")[0]
    if not old:
        return f"{origin}: stage {stage}: {unknown('parameter', name, known)}"
    new = new_names[old]
    if new and re.fullmatch(r"\w+(\.\w+)+", new):
        return f"{origin}: unknown parameter {old}; it is {new} now"
    return f"{origin}: unknown parameter {old}; " + (new or "it is gone")
