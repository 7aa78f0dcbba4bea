"""Merges the layers of parameters, and splits a time budget over stages (docs/development.md#traces)."""

import re
import shlex
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from runner import Refused
from runner.keys import flatten_params
from runner.pipeline import Overrides, Pipeline, SceneFile, unknown_name
from runner.user_yaml import parse_value

SECONDS = "seconds"  # the parameter of a stage that takes its share of the budget


def merge_params(below: dict[str, Any], above: dict[str, Any], atomic: Collection[str] = ()) -> dict[str, Any]:
    """`below` updated with `above`. Mappings merge, except those named in `atomic`; all else is replaced."""
    both = {k for k, v in above.items() if isinstance(v, dict) and isinstance(below.get(k), dict)}.difference(atomic)
    return below | {k: merge_params(below[k], v) if k in both else v for k, v in above.items()}


def parse_set(text: str, pipeline: Pipeline) -> Overrides:
    """Parse `fit.iterations=500 distill.sds.weight=1`; values are YAML."""
    overrides: Overrides = {}
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise Refused(f"set: {text!r}: {error}") from None
    for word in words:
        match = re.fullmatch(r"(\w+)((?:\.\w+)+)=(.*)", word, flags=re.DOTALL)
        if not match:
            raise Refused(f"set: {word!r} is not of the form stage.parameter=value")
        stage, names, value_text = match.groups()
        if stage not in pipeline.stages:
            raise Refused(f"set: {unknown_name('stage', stage, pipeline.stages)}")
        try:
            value = parse_value(value_text, is_text=names.split(".")[1] in pipeline.scene_keys.get(stage, ()))
        except ValueError:
            raise Refused(f"set: the value of {stage}{names} is not valid YAML: {value_text!r:.60}") from None
        for name in reversed(names[1:].split(".")):
            value = {name: value}
        overrides[stage] = merge_params(overrides.get(stage, {}), value)
    return overrides


@dataclass(frozen=True)
class Layers:
    """Parameters as they were asked for.

    `values`: the merged parameters of each stage. `layers`: (name, overrides) of each layer; later ones win.
    """

    values: Overrides
    layers: tuple[tuple[str, Overrides], ...]

    def origin(self, stage: str, name: str) -> str:
        """The last layer that sets a dotted name, a group that contains it, or a part of it."""
        near = lambda other: f"{other}.".startswith(f"{name}.") or f"{name}.".startswith(f"{other}.")
        sets_it = lambda layer: any(map(near, flatten_params(layer.get(stage, {}))))
        return next((label for label, layer in reversed(self.layers) if sets_it(layer)), "pipeline.yaml")


def stack_layers(
    pipeline: Pipeline, scene: SceneFile, profile: str, variant: str | None, asked: Overrides, shares: Overrides
) -> Layers:
    """Merge the layers of parameters.

    Later ones win: stage defaults of pipeline.yaml, profile, shares of a budget, scene.yaml, variant, `set=`.
    Groups of parameters merge. A key of scene.yaml is one value, even where it is a mapping (`reference: {view, image,
    depth}`), and is replaced as a whole."""
    keys, brings = pipeline.scene_keys, scene.brings
    scene_params = {stage: {key: brings[key] for key in keys[stage] if key in brings} for stage in keys}
    layers = (
        ("pipeline.yaml", {name: stage.params for name, stage in pipeline.stages.items()}),
        (f"pipeline.yaml: profile {profile}", pipeline.profiles[profile]),
        ("budget", shares),
        (str(scene.path), scene_params),
        (f"{scene.path}: stages", copy_scene_keys(pipeline, scene.stages)),
        (f"pipeline.yaml: variant {variant}", copy_scene_keys(pipeline, pipeline.variants.get(variant or "", {}))),
        ("set", copy_scene_keys(pipeline, asked)),
    )
    values: Overrides = {name: {} for name in pipeline.stages}
    for _, layer in layers:
        for stage, params in layer.items():
            values[stage] = merge_params(values[stage], params, keys.get(stage, ()))
    return Layers(values, layers)


def copy_scene_keys(pipeline: Pipeline, overrides: Overrides) -> Overrides:
    """`overrides`, with each key of scene.yaml that is set for one stage also set for all others that read it."""
    found = {stage: dict(params) for stage, params in overrides.items()}
    for stage, params in overrides.items():
        for key in (key for key in params if key in pipeline.scene_keys.get(stage, ())):
            for other in (other for other, keys in pipeline.scene_keys.items() if key in keys):
                found.setdefault(other, {}).setdefault(key, params[key])
    return found


def parse_duration(text: object, origin: str) -> float:
    """Seconds of `5m`, `90s`, `1h30m`, `2.5m`, or plain seconds. Raises Refused, naming `origin`, for anything else."""
    number = r"(\d+(?:\.\d+)?)"
    found = re.fullmatch(rf"(?:{number}h)?(?:{number}m)?(?:{number}s)?|{number}", str(text).strip().lower())
    parts = zip(found.groups(), (3600, 60, 1, 1), strict=True) if found else ()
    seconds = sum(float(number or 0) * unit for number, unit in parts)
    if seconds <= 0:
        raise Refused(f"{origin}: budget {text!r} is no time; write it like 5m, 90s or 1h30m")
    return seconds


def split_budget(pipeline: Pipeline, values: Overrides, seconds: float) -> Overrides:
    """stage -> {"seconds": its share}. The shares of stages that `values` lets skip go to the others."""
    if not pipeline.budget:
        raise Refused("pipeline.yaml: a budget is asked for, and there is no table `budget` that shares it out")
    set_params = {f"{stage}.{name}": value for stage in values for name, value in flatten_params(values[stage]).items()}
    has_values = lambda expected: all(set_params.get(param, ...) == value for param, value in expected.items())
    is_true = lambda c: c.param and has_values(dict.fromkeys(c.param, c.equals) | c.only)
    remaining = [name for name in pipeline.budget if not any(is_true(c) for c in pipeline.stages[name].skip_if)]
    if not remaining:
        return {}
    scale = sum(pipeline.budget.values()) / sum(pipeline.budget[name] for name in remaining)
    return {name: {SECONDS: round(seconds * scale * pipeline.budget[name], 3)} for name in remaining}
