"""Merging of the layers of parameters, and splitting of a time budget over stages (docs/development.md#traces).

Each source of parameters, such as a profile or scene.yaml, is a layer. Overrides are a dict stage -> parameter ->
value, in which groups of parameters are nested dicts.
"""

import re
import shlex
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from runner import Refused
from runner.keys import flatten_params
from runner.pipeline import Overrides, Pipeline, SceneFile, check_known
from runner.user_yaml import parse_value

SECONDS = "seconds"  # name of the parameter that is set to the stage's share of the time budget


def merge_params(below: dict[str, Any], above: dict[str, Any], atomic: Collection[str] = ()) -> dict[str, Any]:
    """Return a new dict: `below` overridden by `above`. Both stay unchanged.

    A value that is a mapping in both is merged recursively, unless it is at the top level and its key is in `atomic`.
    All other values of `above` replace those of `below`.
    """
    both = {k for k, v in above.items() if isinstance(v, dict) and isinstance(below.get(k), dict)}.difference(atomic)
    return below | {k: merge_params(below[k], v) if k in both else v for k, v in above.items()}


def parse_set(text: str, pipeline: Pipeline) -> Overrides:
    """Parse the text of `set=`, such as `fit.iterations=500 distill.sds.weight=1`, whose values are YAML.

    The value of a parameter that is also a key of scene.yaml is not converted to numbers or booleans: it stays text, as
    in scene.yaml. If a parameter occurs twice, the last one counts. Whether parameters exist is not checked.

    Returns:
        Overrides: stage -> parameter, or group of parameters -> value.

    Raises:
        Refused: a word has another form, a stage is unknown, or a value is not valid YAML.
    """
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
        check_known("set", "stage", stage, pipeline.stages)
        try:
            value = parse_value(value_text, is_text=names.split(".")[1] in pipeline.scene_keys.get(stage, ()))
        except ValueError:
            raise Refused(f"set: the value of {stage}{names} is not valid YAML: {value_text!r:.60}") from None
        for name in reversed(f"{stage}{names}".split(".")):
            value = {name: value}
        overrides = merge_params(overrides, value)
    return overrides


@dataclass(frozen=True)
class Layers:
    """The parameters as they were asked for, before stages add defaults and check them.

    Attributes:
        values: stage -> its merged parameters.
        layers: (name, overrides) of each layer; a later layer overrides an earlier one.
    """

    values: Overrides
    layers: tuple[tuple[str, Overrides], ...]

    def origin(self, stage: str, name: str) -> str:
        """Return the name of the last layer that sets a parameter, for error messages; "pipeline.yaml" if none does.

        A layer also counts if it sets a group that contains the parameter, or a part of the parameter.

        Args:
            stage: the stage.
            name: dotted name of the parameter.
        """
        near = lambda other: f"{other}.".startswith(f"{name}.") or f"{name}.".startswith(f"{other}.")
        sets_it = lambda layer: any(map(near, flatten_params(layer.get(stage, {}))))
        found = next((label for label, layer in reversed(self.layers) if sets_it(layer)), None)
        # a key that a group lacks is to be added where the group is set
        above, _, _ = name.rpartition(".")
        return found or (self.origin(stage, above) if above else "pipeline.yaml")


def stack_layers(
    pipeline: Pipeline, scene: SceneFile, profile: str, variant: str | None, asked: Overrides, shares: Overrides
) -> Layers:
    """Merge the layers of parameters.

    The layers are, from low to high priority: the profile, shares of a time budget, scene.yaml, the variant, and
    `set=`. Groups of parameters are merged. A key of scene.yaml is one value, even
    if it is a mapping (`reference: {view, image, depth}`), and is replaced as a whole.

    Args:
        scene: the content of scene.yaml.
        profile: name of the profile.
        variant: name of the variant; None for the scene's own run.
        asked: overrides of `set=`.
        shares: overrides that give each stage its share of a time budget; empty without a budget.
    """
    keys, brings = pipeline.scene_keys, scene.brings
    scene_params = {stage: {key: brings[key] for key in keys[stage] if key in brings} for stage in keys}
    layers = (
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
    """Return new overrides in which a key of scene.yaml has one value for all stages that read this key.

    A key that `overrides` sets for one stage is also set for the other stages that read the key, wherever the value
    comes from: scene.yaml, a variant or `set=`. A stage for which the key is already set keeps its value.
    """
    found = {stage: dict(params) for stage, params in overrides.items()}
    for stage, params in overrides.items():
        for key in (key for key in params if key in pipeline.scene_keys.get(stage, ())):
            for other in (other for other, keys in pipeline.scene_keys.items() if key in keys):
                found.setdefault(other, {}).setdefault(key, params[key])
    return found


def parse_duration(text: object, origin: str) -> float:
    """Convert a duration such as `5m`, `90s`, `1h30m`, `2.5m`, or a plain number of seconds, to seconds.

    Args:
        text: the duration.
        origin: where the duration was given, for the message.

    Raises:
        Refused: the text has another form, or the duration is 0.
    """
    number = r"(\d+(?:\.\d+)?)"
    found = re.fullmatch(rf"(?:{number}h)?(?:{number}m)?(?:{number}s)?|{number}", str(text).strip().lower())
    parts = zip(found.groups(), (3600, 60, 1, 1), strict=True) if found else ()
    seconds = sum(float(number or 0) * unit for number, unit in parts)
    if seconds <= 0:
        raise Refused(f"{origin}: budget {text!r} is no time; write it like 5m, 90s or 1h30m")
    return seconds


def split_budget(pipeline: Pipeline, values: Overrides, seconds: float) -> Overrides:
    """Give the stages of the table `budget` in pipeline.yaml their fractions of a time budget.

    The fractions may add up to less than 1; the rest of the time is for the other stages. A stage that is skipped
    because of its parameters gets nothing. Its fraction is divided among the other stages of the table in proportion to
    their fractions.

    Args:
        values: stage -> its merged parameters.
        seconds: the budget for all stages together.

    Returns:
        Overrides: stage -> {"seconds": its share}, without the skipped stages.

    Raises:
        Refused: pipeline.yaml has no table `budget`.
    """
    if not pipeline.budget:
        raise Refused("pipeline.yaml: a budget is asked for, and there is no table `budget` that shares it out")
    asked = flatten_params(values).items()
    is_true = lambda condition: condition.param and condition.expected.items() <= asked
    remaining = [name for name in pipeline.budget if not any(map(is_true, pipeline.stages[name].skip_if))]
    if not remaining:
        return {}
    scale = sum(pipeline.budget.values()) / sum(pipeline.budget[name] for name in remaining)
    return {name: {SECONDS: round(seconds * scale * pipeline.budget[name], 3)} for name in remaining}
