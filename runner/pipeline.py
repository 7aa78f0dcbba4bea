"""Models of `pipeline.yaml` and `scene.yaml`, with their checks, and the search for scenes.

Parameters are named `<stage>.<name>` here, with dots for groups, such as `distill.sds.weight`.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

import yaml
from pydantic import BaseModel, BeforeValidator, NonNegativeFloat, PositiveFloat, ValidationError, model_validator

from reffusion.command import scene_name, scene_path, workplace
from runner import Refused
from runner.text import unknown_name
from runner.user_yaml import read_user_yaml

SCENE = "scene"  # the need that stands for the scene's own folder
NAME = re.compile(r"[\w'][\w'\" .,()+\-]*")  # names of scenes; they have no characters of file patterns, and no @
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the loader in C takes a tenth of the time

Overrides = dict[str, dict[str, Any]]  # stage -> parameter, or group of parameters -> value


class Strict(BaseModel, extra="forbid", frozen=True):
    """Base class of the parts of pipeline.yaml, in which unknown keys are errors."""


class ByParameters(Strict):
    """A part of pipeline.yaml that applies only while parameters have certain values.

    Attributes:
        param: <stage>.<name>, or several such names, of any stages; these parameters must equal `equals`.
        equals: see `param`.
        only: <stage>.<name> -> the value that this parameter must have.
    """

    param: Annotated[tuple[str, ...], BeforeValidator(lambda value: (value,) if isinstance(value, str) else value)] = ()
    equals: Any = None
    only: dict[str, Any] = {}

    @property
    def expected(self) -> dict[str, Any]:
        """The parameters, <stage>.<name>, that must have certain values, with these values."""
        return self.only | dict.fromkeys(self.param, self.equals)


class Condition(ByParameters):
    """A condition under which a stage is skipped. It tests exactly one of `fact`, `param` and `empty`.

    Attributes:
        reason: why the stage is skipped, for the user; may name facts of the tested stage in braces.
        fact: <stage>.<name>; true if this value of an earlier stage's facts.json equals `equals`.
        empty: <stage>/<folder>; true if this folder of an earlier stage's artifact has no files.
        unless: the condition is false if scene.yaml has one of these keys.
    """

    reason: str
    fact: str | None = None
    empty: str | None = None
    unless: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _has_one_test(self) -> Self:
        """Raise ValueError unless exactly one of `fact`, `param` and `empty` is set."""
        if sum(map(bool, (self.fact, self.param, self.empty))) != 1:
            raise ValueError("a condition has one of `fact`, `param`, `empty`")
        return self

    @property
    def names(self) -> tuple[str, str]:
        """The stage that the condition tests, and the name of the (first) fact, parameter or folder."""
        stage, name = re.split(r"[./]", self.fact or self.empty or self.param[0], maxsplit=1)
        return stage, name


class Substitute(ByParameters):
    """The replacement of a stage by a file that the scene brings.

    If scene.yaml has the key `by`, the artifact of the earlier stage `artifact` is used instead of the stage's own.

    Attributes:
        by: key of scene.yaml.
        artifact: name of the earlier stage.
    """

    by: str
    artifact: str


class Stage(Strict):
    """A stage of the pipeline, as pipeline.yaml describes it.

    Attributes:
        needs: earlier stages whose artifacts the stage reads, and `scene` for the folder of the scene. If one of them
            is skipped, the stage is skipped too.
        optional: further needs that may be skipped; the stage then gets None instead of a folder.
        provided: the file of the scene that may replace the stage.
        ignore: optional need -> parameters with values, as in `only`. While all have these values, the stage does not
            read the need: it gets None, and does not run again when the need changes.
        skip_if: the stage is skipped if one of these conditions is true.
        export: folders of the artifact that are copied to runs/<scene>/, where people work with the files.
    """

    needs: tuple[str, ...]
    optional: tuple[str, ...] = ()
    provided: Substitute | None = None
    ignore: dict[str, dict[str, Any]] = {}
    skip_if: tuple[Condition, ...] = ()
    export: tuple[str, ...] = ()

    @property
    def all_needs(self) -> tuple[str, ...]:
        """All needs, optional ones last. They are the keyword arguments of the stage's run()."""
        return (*self.needs, *self.optional)

    @property
    def depends_on(self) -> tuple[str, ...]:
        """All needs, and the stages that must be done before a condition can be tested or the stage be replaced."""
        tested = (condition.names[0] for condition in self.skip_if if not condition.param)
        replaced = [self.provided.artifact] if self.provided else []
        return (*self.all_needs, *tested, *replaced, *self.ignore)


class Memory(Strict):
    """The expected CPU memory of a stage: `mb` MB, and `each` MB more per MB of files in the folders of its needs."""

    mb: PositiveFloat
    each: NonNegativeFloat = 0


class Rates(Strict):
    """The expected seconds of a stage: `base`, and those for each training view, test view and step.

    Attributes:
        megapixels: size of the views for which `view` and `step` hold; for other views these two change in proportion.
            0 if they do not depend on the size.
        device: the device on which they were measured, "cpu" or "cuda".
        placed: seconds for each training view whose pose structure from motion has to find.
        steps: the parameter of the stage that counts its steps; "" if it has none.
    """

    base: NonNegativeFloat
    view: NonNegativeFloat = 0
    test: NonNegativeFloat = 0
    placed: NonNegativeFloat = 0
    step: NonNegativeFloat = 0
    steps: str = ""
    device: str = "cpu"
    megapixels: NonNegativeFloat = 0


class Pipeline(Strict):
    """The content of pipeline.yaml.

    Attributes:
        stages: name -> stage, in the order in which they run.
        scene_keys: stage -> keys of scene.yaml that are parameters of this stage.
        profiles, variants: name -> parameters by stage.
        comparisons: profile of a scene -> profile in which `compare` runs all methods but the scene's own run. Without
            an entry this is the scene's profile, too.
        budget: stage -> its part of a time budget, as a fraction; the sum is at most 1.
        memory: stage -> expected memory, used while no earlier run has measured it.
        durations: profile -> stage -> its expected seconds on two cores or an H200, used likewise.
        gpus: name of a GPU -> how many times longer it takes than an H200.
    """

    stages: dict[str, Stage]
    scene_keys: dict[str, tuple[str, ...]]
    profiles: dict[str, Overrides]
    variants: dict[str, Overrides] = {}
    comparisons: dict[str, str] = {}
    budget: dict[str, PositiveFloat] = {}
    memory: dict[str, Memory] = {}
    durations: dict[str, dict[str, Rates]] = {}
    gpus: dict[str, PositiveFloat] = {}

    @model_validator(mode="after")
    def _names_are_known(self) -> Self:
        """Raise ValueError if a stage or profile is unknown, a need is no earlier stage, or the budget exceeds 1."""
        earlier = [SCENE]
        for name, stage in self.stages.items():
            for need in (need for need in stage.depends_on if need not in earlier):
                raise ValueError(f"stage {name} names {need!r}, which is not a stage before it")
            earlier.append(name)
        tables: dict[str, Any] = {"scene_keys": self.scene_keys, "budget": self.budget, "memory": self.memory}
        named = [*tables.items(), *self.durations.items(), *self.profiles.items(), *self.variants.items()]
        for label, stage in ((label, stage) for label, table in named for stage in table if stage not in self.stages):
            raise ValueError(f"{label} names {unknown_name('stage', stage, self.stages)}")
        for name in (name for pair in self.comparisons.items() for name in pair if name not in self.profiles):
            raise ValueError(f"comparisons names {unknown_name('profile', name, self.profiles)}")
        if sum(self.budget.values()) > 1:
            raise ValueError(f"budget: the parts add up to {sum(self.budget.values()):g}, which is more than 1")
        return self

    def closure(self, target: str) -> list[str]:
        """Return a stage and all stages that it, or its conditions, need directly or indirectly, in order.

        Args:
            target: name of the stage; "all" for all stages.

        Raises:
            Refused: the stage is unknown.
        """
        if target == "all":
            return list(self.stages)
        check_known("pipeline.yaml", "stage", target, ["all", *self.stages])
        names = {target}
        for name in reversed(self.stages):
            if name in names:
                names |= {*self.stages[name].depends_on}
        return [name for name in self.stages if name in names]


def check_known(origin: str, kind: str, name: str | None, known: Iterable[str]) -> None:
    """Raise Refused if a name that was given is unknown; None stands for a name that was not given.

    Args:
        origin: where the name was given, for the message.
        kind, known: as in `text.unknown_name`.
        name: the name.
    """
    if name is not None and name not in known:
        raise Refused(f"{origin}: {unknown_name(kind, name, known)}")


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file of the project as a dict, which is empty for an empty file.

    Raises:
        Refused: the file is not valid YAML, or not a mapping.
    """
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), LOADER)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise Refused(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict | None):
        raise Refused(f"{path}: expected `key: value` lines, found a {type(content).__name__}")
    return content or {}


def load_pipeline(root: Path) -> Pipeline:
    """Read pipeline.yaml in the folder `root`.

    Raises:
        Refused: the file is missing or ill-formed, or names an unknown stage or profile.
    """
    path = root / "pipeline.yaml"
    if not path.is_file():
        raise Refused(f"{path}: no such file; the runner's --root is the folder that holds it")
    try:
        return Pipeline.model_validate(read_yaml(path))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) + ": " * bool(first["loc"])
        raise Refused(f"{path}: {where}{first['msg'].removeprefix('Value error, ')}") from None


@dataclass(frozen=True)
class SceneFile:
    """The content of a scene's optional scene.yaml.

    Attributes:
        path: path of the file, which need not exist.
        profile: name of the profile; None if the file names none.
        brings: the keys that describe the scene, such as `reference`, with their values; keys without a value are left
            out.
        stages: parameters by stage, the content of the key `stages`.
        budget: time budget, as written; None without one.
    """

    path: Path
    profile: str | None
    brings: dict[str, Any]
    stages: Overrides
    budget: Any = None


def load_scene_file(folder: Path, pipeline: Pipeline) -> SceneFile:
    """Read the scene.yaml in a scene's folder; the content is empty if there is no such file.

    Raises:
        Refused: the file cannot be read (`read_user_yaml`), a key or stage is unknown, or a value has a wrong type.
    """
    path = folder / "scene.yaml"
    content = read_user_yaml(path, typed=("stages",))
    keys = [key for names in pipeline.scene_keys.values() for key in names]
    known = [*keys, "profile", "budget", "stages"]
    for key in content:
        check_known(str(path), "key", key, known)
    stages = content.get("stages") or {}
    if not isinstance(stages, dict) or not all(isinstance(v, dict) for v in stages.values()):
        raise Refused(f"{path}: stages: expected {{stage: {{parameter: value}}}}")
    for stage in stages:
        check_known(f"{path}: stages", "stage", stage, pipeline.stages)
    if not isinstance(content.get("profile"), str | None):
        raise Refused(f"{path}: profile: expected the name of one")
    brings = {key: value for key, value in content.items() if key in keys and value is not None}
    return SceneFile(path, content.get("profile"), brings, stages, content.get("budget"))


def find_scene(text: str, root: Path) -> Path:
    """Find the folder or video that `scene=` means, as an absolute path.

    Args:
        text: a name under data/, or else a path.
        root: folder with pipeline.yaml.

    Raises:
        Refused: there is no such folder or video, or its name has characters that are not allowed.
    """
    scene = scene_path(text, root)
    if scene is not None:
        if NAME.fullmatch(scene_name(scene)):
            return scene
        allowed = "letters, digits, blanks and _ . , - + ' ( )"
        raise Refused(f"{scene}: a scene is called by its folder's name; use {allowed} only")
    known = ", ".join(sorted(path.name for path in (workplace(root) / "data").glob("[!._]*/"))) or "none"
    absent = "folder or video" if Path(text).is_absolute() else f"folder data/{text}, nor one or a video"
    where = f"there is no {absent} at that path; known: {known} (`reffusion demo` makes data/demo)"
    raise Refused(f"unknown scene {text!r}: {where}")
