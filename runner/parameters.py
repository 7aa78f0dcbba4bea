"""Parameters as they are asked for: layer over layer, and a time budget shared out over stages (docs/traces.md)."""

import re
import shlex
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from runner import Refused
from runner.user_yaml import value_of
from runner.keys import leaves
from runner.pipeline import Overrides, Pipeline, SceneFile, unknown

SHARE = "seconds"  # the parameter of a stage that is its share of the budget


def merged(below: dict[str, Any], above: dict[str, Any], whole: Collection[str] = ()) -> dict[str, Any]:
    """`above` over `below`. A mapping over a mapping merges, but for those called `whole`; all else replaces."""
    both = {k for k, v in above.items() if isinstance(v, dict) and isinstance(below.get(k), dict)}.difference(whole)
    return below | {k: merged(below[k], v) if k in both else v for k, v in above.items()}


def parse_set(text: str, pipeline: Pipeline) -> Overrides:
    """`fit.iterations=500 distill.sds.weight=1`; the values are read as YAML."""
    overrides: Overrides = {}
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise Refused(f"set: {text!r}: {error}") from None
    for word in words:
        match = re.fullmatch(r"(\w+)((?:\.\w+)+)=(.*)", word, flags=re.DOTALL)
        if not match:
            raise Refused(f"set: {word!r} is not of the form stage.parameter=value")
        stage, names, given = match.groups()
        if stage not in pipeline.stages:
            raise Refused(f"set: {unknown('stage', stage, pipeline.stages)}")
        try:
            value = value_of(given, is_text=names.split(".")[1] in pipeline.scene_keys.get(stage, ()))
        except ValueError:
            raise Refused(f"set: the value of {stage}{names} is not valid YAML: {given!r:.60}") from None
        for name in reversed(names[1:].split(".")):
            value = {name: value}
        overrides[stage] = merged(overrides.get(stage, {}), value)
    return overrides


@dataclass(frozen=True)
class Layers:
    """Parameters as they were asked for, of each stage, and who asked for what: (name, what it says), last wins."""

    values: Overrides
    each: tuple[tuple[str, Overrides], ...]

    def origin(self, stage: str, name: str) -> str:
        """The layer that asked last for a dotted name, for what it is a part of, or for a part of it."""
        near = lambda other: f"{other}.".startswith(f"{name}.") or f"{name}.".startswith(f"{other}.")
        saying = (label for label, layer in reversed(self.each) if any(map(near, leaves(layer.get(stage, {})))))
        return next(saying, "pipeline.yaml")


def layered(
    pipeline: Pipeline, scene: SceneFile, profile: str, variant: str | None, asked: Overrides, shares: Overrides
) -> Layers:
    """Later layers win: stage defaults in pipeline.yaml, profile, shares of a budget, scene.yaml, variant, `set=`.

    Groups of parameters merge. What goes by a key of scene.yaml is a value, also where it is a mapping (`reference:
    {view, image, depth}`), and is replaced whole."""
    keys, brings = pipeline.scene_keys, scene.brings
    brought = {stage: {key: brings[key] for key in keys[stage] if key in brings} for stage in keys}
    each = (
        ("pipeline.yaml", {name: stage.params for name, stage in pipeline.stages.items()}),
        (f"pipeline.yaml: profile {profile}", pipeline.profiles[profile]),
        ("budget", shares),
        (str(scene.path), brought),
        (f"{scene.path}: stages", share_scene_keys(pipeline, scene.stages)),
        (f"pipeline.yaml: variant {variant}", share_scene_keys(pipeline, pipeline.variants.get(variant or "", {}))),
        ("set", share_scene_keys(pipeline, asked)),
    )
    values: Overrides = {name: {} for name in pipeline.stages}
    for _, layer in each:
        for stage, params in layer.items():
            values[stage] = merged(values[stage], params, keys.get(stage, ()))
    return Layers(values, each)


def share_scene_keys(pipeline: Pipeline, overrides: Overrides) -> Overrides:
    """`overrides` with a key of scene.yaml set for every stage that reads it, where it is set for one of them."""
    found = {stage: dict(params) for stage, params in overrides.items()}
    for stage, params in overrides.items():
        for key in (key for key in params if key in pipeline.scene_keys.get(stage, ())):
            for other in (other for other, keys in pipeline.scene_keys.items() if key in keys):
                found.setdefault(other, {}).setdefault(key, params[key])
    return found


def seconds_of(text: object, origin: str) -> float:
    """`5m`, `90s`, `1h30m`, `2.5m`, or plain seconds; Refused, naming `origin`, for anything else."""
    number = r"(\d+(?:\.\d+)?)"
    found = re.fullmatch(rf"(?:{number}h)?(?:{number}m)?(?:{number}s)?|{number}", str(text).strip().lower())
    parts = zip(found.groups(), (3600, 60, 1, 1), strict=True) if found else ()
    seconds = sum(float(number or 0) * unit for number, unit in parts)
    if seconds <= 0:
        raise Refused(f"{origin}: budget {text!r} is no time; write it like 5m, 90s or 1h30m")
    return seconds


def shared_out(pipeline: Pipeline, values: Overrides, seconds: float) -> Overrides:
    """stage -> {"seconds": its share}. The shares of stages that `values`, as asked for, leave out go to others."""
    if not pipeline.budget:
        raise Refused("pipeline.yaml: a budget is asked for, and there is no table `budget` that shares it out")
    asked = {f"{stage}.{name}": value for stage in values for name, value in leaves(values[stage]).items()}
    is_so = lambda wanted: all(asked.get(param, ...) == value for param, value in wanted.items())
    holds = lambda c: c.param and is_so(dict.fromkeys(c.param, c.equals) | c.only)
    stays = [name for name in pipeline.budget if not any(holds(c) for c in pipeline.stages[name].left_out)]
    if not stays:
        return {}
    scale = sum(pipeline.budget.values()) / sum(pipeline.budget[name] for name in stays)
    return {name: {SHARE: round(seconds * scale * pipeline.budget[name], 3)} for name in stays}
