"""`pipeline.yaml` and `scene.yaml`: what they say, checked."""

import difflib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

import yaml
from pydantic import BaseModel, BeforeValidator, Field, ValidationError, model_validator

from reffusion.command import workplace
from runner import Refused
from runner.user_yaml import read_handed

SCENE = "scene"  # the need that stands for the scene's own folder
NAME = re.compile(r"[\w'][\w'\" .,()+\-]*")  # of a scene; none that patterns or variants could be made of
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the one in C takes a tenth of the time

Overrides = dict[str, dict[str, Any]]  # stage -> parameter, or group of parameters -> value


class Strict(BaseModel, extra="forbid", frozen=True):
    """As all of pipeline.yaml: a name that is not known is refused."""


class Condition(Strict):
    """A reason to leave a stage out: one question, by `fact`, `param` or `empty`, whose answer is yes."""

    because: str  # may name facts of that stage in braces
    fact: str | None = None  # <stage>.<name>: of an earlier stage's facts.json, is `equals`
    # <stage>.<name>, or a list of them: parameters of any stage, each `equals`
    param: Annotated[tuple[str, ...], BeforeValidator(lambda said: (said,) if isinstance(said, str) else said)] = ()
    equals: Any = None
    empty: str | None = None  # <stage>/<folder>: of an earlier artifact, is without a file
    unless: tuple[str, ...] = ()  # ignored where the scene brings one of these keys
    only: dict[str, Any] = {}  # ignored unless each <stage>.<name>, a parameter, has this value

    @model_validator(mode="after")
    def _one_question(self) -> Self:
        if sum(map(bool, (self.fact, self.param, self.empty))) != 1:
            raise ValueError("a condition has one of `fact`, `param`, `empty`")
        return self

    @property
    def names(self) -> tuple[str, str]:
        """The stage the question is about, and the name of the fact, parameter or folder."""
        stage, name = re.split(r"[./]", self.fact or self.empty or self.param[0], maxsplit=1)
        return stage, name

    @property
    def waits_for(self) -> tuple[str, ...]:
        """The stage that must be done before there is an answer, if any."""
        return () if self.param else self.names[:1]


class Provided(Strict):
    """The scene's own file stands for the stage: where scene.yaml has the key `by`, `artifact` is used in its place;
    where `param: <stage>.<name>` is given, only while that parameter is `equals`."""

    by: str
    artifact: str
    param: str | None = None
    equals: Any = None


class Unread(Strict):
    """An optional need that the stage does not read while `param: <stage>.<name>` is `equals`: it arrives as None, and
    where it changes, the stage does not run again."""

    need: str
    param: str
    equals: Any


class Stage(Strict):
    """needs: earlier stages, or `scene`. optional: needs that may be left out, and then arrive as None. hands_out:
    folders of its artifact that people work with, copied to runs/<scene>/ where they outlive it."""

    needs: tuple[str, ...]
    optional: tuple[str, ...] = ()
    provided: Provided | None = None
    unread: Unread | None = None
    left_out: tuple[Condition, ...] = ()
    hands_out: tuple[str, ...] = ()
    params: dict[str, Any] = {}

    @property
    def takes(self) -> tuple[str, ...]:
        """All that run() is handed."""
        return (*self.needs, *self.optional)


class Memory(Strict):
    """What a stage takes of the CPU's: MB of itself, and MB for each MB of the files that it reads."""

    mb: Annotated[float, Field(gt=0)]
    each: Annotated[float, Field(ge=0)] = 0


class Pipeline(Strict):
    """The stages in order; parameters by profile and by variant; the keys of scene.yaml and the stages they go to; the
    profile in which a profile's methods are compared, where it is another; the parts of a time budget that stages get;
    what memory they take, where no earlier run tells."""

    stages: dict[str, Stage]
    scene_keys: dict[str, tuple[str, ...]]
    profiles: dict[str, Overrides]
    variants: dict[str, Overrides] = {}
    comparisons: dict[str, str] = {}
    budget: dict[str, Annotated[float, Field(gt=0)]] = {}
    memory: dict[str, Memory] = {}

    @model_validator(mode="after")
    def _names_are_known(self) -> Self:
        earlier = [SCENE]
        for name, stage in self.stages.items():
            named = [*stage.takes, *(need for c in stage.left_out for need in c.waits_for)]
            named += [stage.provided.artifact] if stage.provided else []
            named += [stage.unread.need] if stage.unread else []
            for need in named:
                if need not in earlier:
                    raise ValueError(f"stage {name} names {need!r}, which is not a stage before it")
            earlier.append(name)
        tables: dict[str, Iterable[str]] = {
            "scene_keys": self.scene_keys,
            "budget": self.budget,
            "memory": self.memory,
            **self.profiles,
            **self.variants,
        }
        for label, layer in tables.items():
            for stage in layer:
                if stage not in self.stages:
                    raise ValueError(f"{label} names {unknown('stage', stage, self.stages)}")
        for name in (name for pair in self.comparisons.items() for name in pair if name not in self.profiles):
            raise ValueError(f"comparisons names {unknown('profile', name, self.profiles)}")
        if sum(self.budget.values()) > 1:
            raise ValueError(f"budget: the parts add up to {sum(self.budget.values()):g}, which is more than 1")
        return self

    def closure(self, target: str) -> list[str]:
        """`target` and all it needs, in order; every stage for `all`."""
        if target == "all":
            return list(self.stages)
        if target not in self.stages:
            raise Refused(f"pipeline.yaml: {unknown('stage', target, ['all', *self.stages])}")
        wanted = {target}
        for name in reversed(self.stages):
            if name in wanted:
                stage = self.stages[name]
                wanted |= {*stage.takes, *(need for c in stage.left_out for need in c.waits_for)}
        return [name for name in self.stages if name in wanted]


def unknown(kind: str, name: object, known: Any) -> str:
    """Words for a name that is not known: the one that was meant, or all there are."""
    known = [str(k) for k in known]
    near = difflib.get_close_matches(str(name), known, n=1)
    return f"unknown {kind} {name!r}; " + (f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}")


def read_yaml(path: Path) -> dict[str, Any]:
    """Raises Refused where it is not valid, or holds no `key: value` lines."""
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), LOADER)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise Refused(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict | None):
        raise Refused(f"{path}: expected `key: value` lines, found a {type(content).__name__}")
    return content or {}


def load_pipeline(root: Path) -> Pipeline:
    """Raises Refused where pipeline.yaml is missing, ill-formed, or names a stage that is not there."""
    path = root / "pipeline.yaml"
    if not path.is_file():
        raise Refused(f"{path}: no such file; the runner's --root is the folder that holds it")
    try:
        return Pipeline.model_validate(read_yaml(path))
    except ValidationError as error:
        first = error.errors()[0]
        where = "".join(f"{part}." for part in first["loc"])[:-1]
        raise Refused(f"{path}: {where + ': ' if where else ''}{first['msg'].removeprefix('Value error, ')}") from None


@dataclass(frozen=True)
class SceneFile:
    """What a scene's optional scene.yaml says."""

    path: Path  # the file, present or not
    profile: str | None
    brings: dict[str, Any]  # the keys, with values, that describe the scene
    stages: Overrides
    budget: Any = None


def load_scene_file(folder: Path, pipeline: Pipeline) -> SceneFile:
    path = folder / "scene.yaml"
    content = read_handed(path, typed=("stages",))
    keys = [key for names in pipeline.scene_keys.values() for key in names]
    known = [*keys, "profile", "budget", "stages"]
    for key in (key for key in content if key not in known):
        raise Refused(f"{path}: {unknown('key', key, known)}")
    stages = content.get("stages") or {}
    if not isinstance(stages, dict) or not all(isinstance(v, dict) for v in stages.values()):
        raise Refused(f"{path}: stages: expected {{stage: {{parameter: value}}}}")
    for stage in (stage for stage in stages if stage not in pipeline.stages):
        raise Refused(f"{path}: stages: {unknown('stage', stage, pipeline.stages)}")
    if not isinstance(content.get("profile"), str | None):
        raise Refused(f"{path}: profile: expected the name of one")
    brings = {key: value for key, value in content.items() if key in keys and value is not None}
    return SceneFile(path, content.get("profile"), brings, stages, content.get("budget"))


def scene_name(scene: Path) -> str:
    """What the scene in a folder, or of a video, is called."""
    return scene.stem if scene.is_file() else scene.name


def find_scene(text: str, root: Path) -> Path:
    """What is meant by `scene=`, a name under data/ or a path: a folder, or a file that is taken for a video."""
    data = workplace(root) / "data"
    for scene in (data / text, Path(text).expanduser()):
        if text and (scene.is_dir() or scene.is_file()):
            scene = scene.resolve()
            if not NAME.fullmatch(scene_name(scene)):
                raise Refused(
                    f"{scene}: a scene is called by its folder's name; use letters, digits, blanks and "
                    "_ . , - + ' ( ) only"
                )
            return scene
    known = sorted(p.name for p in data.glob("[!._]*/")) if data.is_dir() else []
    raise Refused(
        f"unknown scene {text!r}: there is no folder data/{text}, nor one or a video at that path; "
        f"known: {', '.join(known) or 'none'} (`make demo` makes one, in a checkout)"
    )
