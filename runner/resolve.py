"""The first step: turns a request into a job, with everything that it names read and checked."""

import json
import os
import shlex
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from runner import Refused
from runner.files import list_files, read_text
from runner.frames import FRAMES, update_frames
from runner.keys import HASHES, Hashes, code_fingerprints, digest, files_outside, paths_outside
from runner.parameters import Layers, parse_duration, parse_set, split_budget, stack_layers
from runner.pipeline import (
    SCENE,
    Pipeline,
    SceneFile,
    find_scene,
    load_pipeline,
    load_scene_file,
    scene_name,
    unknown_name,
)
from runner.process import ask_stages

AUTO = "auto"  # the profile that suits this machine
WORKER = Path(__file__).with_name("worker.py")
CACHED = "answer "  # prefix of the keys of answers that are cached


@dataclass(frozen=True)
class Request:
    """What the command line asks for: texts as typed, None where not given."""

    root: Path
    runs: Path
    scene: str
    profile: str | None = None
    variant: str | None = None
    trust: bool = False
    set: str = ""
    budget: str | None = None
    keep: bool = False
    cuda: bool | None = None  # do the machines that run stages have a GPU? None: stages run here, see `has_cuda`
    compared: bool = False  # use the profile that `comparisons` of pipeline.yaml names


@dataclass(frozen=True)
class StageInfo:
    """A stage's description of itself."""

    params: dict[str, Any]  # all parameters, groups nested
    weights: tuple[str, ...] = ()  # dotted names of the parameters that name weights
    unkeyed: tuple[str, ...] = ()  # dotted names of the parameters that do not change the artifact
    reads: tuple[str, ...] | None = None  # the files of the scene that it reads; None: all
    facts: dict[str, Any] = field(default_factory=dict)  # what it uses of other files, such as their names
    machine: dict[str, str] = field(default_factory=dict)  # properties of this machine that it depends on
    unavailable: tuple[str, ...] = ()  # optional things that this machine does not have


@dataclass(frozen=True)
class ResolvedJob:
    """One scene with all its settings, resolved and checked."""

    root: Path
    runs: Path
    folder: Path  # the scene's folder; the root for a job without a scene
    home: Path  # runs/<scene>, or runs/<scene>@<variant>
    base: Path  # runs/<scene>: artifacts that variants share
    pipeline: Pipeline
    layers: Layers  # parameters as they were asked for
    profile: str
    why: str  # the reason for this profile
    trust: bool
    brings: frozenset[str]  # the keys of scene.yaml that have values
    hashes: Hashes
    keep: bool = False  # keep artifacts that people changed
    cuda: bool | None = None  # as in Request
    stages: dict[str, StageInfo] = field(default_factory=dict)
    broken: dict[str, str] = field(default_factory=dict)  # stages that cannot be imported -> what is wrong

    @property
    def params(self) -> dict[str, dict[str, Any]]:
        """stage -> all its parameters."""
        return {stage: each.params for stage, each in self.stages.items()}

    def question(self, stage: str) -> dict[str, Any]:
        """The question to a stage about its weights, see `worker.describe`. They depend on what the scene brings: keys
        of its scene.yaml and its folders. The answer is not cached, as weights come and go."""
        folders = [path.name for path in self.folder.iterdir() if path.is_dir()] if self.folder != self.root else ()
        question = {"stage": stage, "params": self.stages[stage].params, "takes": self.pipeline.stages[stage].all_needs}
        return question | {"brings": sorted({*self.brings, *folders})}


def resolve(request: Request, hashes: Hashes | None = None, scene: bool = True) -> ResolvedJob:
    """Read and check everything that a request names; with `scene=False` for no scene in particular.

    Raises:
        Refused: something is wrong; the message says how to fix it.
    """
    return resolve_all([request], hashes or Hashes(request.runs / HASHES), scene)[0]


def resolve_all(requests: list[Request], hashes: Hashes, scene: bool = True) -> list[ResolvedJob]:
    """Resolve several requests with one root. Asks all stages at once, and only what is not in the cache."""
    drafts = [_draft(request, hashes, scene) for request in requests]
    questions = [_questions(job) for job in drafts]
    new = {name: question for each in questions for name, question in each.items() if name not in hashes.known}
    answers = dict(zip(new, ask_stages(requests[0].root, list(new.values())), strict=True))
    may_cache = lambda key, answer: (
        key.startswith(CACHED) and "params" in answer and not (answer.get("unavailable") or answer.get("machine"))
    )
    inside = lambda question, answer: (
        not any(files_outside(answer.get("reads") or (), Path(question.get("scene", "."))))
    )
    hashes.known |= {k: answer for k, answer in answers.items() if may_cache(k, answer) and inside(new[k], answer)}
    return [_add_descriptions(job, each, hashes.known | answers) for job, each in zip(drafts, questions, strict=True)]


def _draft(request: Request, hashes: Hashes, scene: bool) -> ResolvedJob:
    """A job without the descriptions of its stages."""
    root, runs, variant, pipeline = request.root, request.runs, request.variant, load_pipeline(request.root)
    source = find_scene(request.scene, root) if scene else None
    base = runs / (scene_name(source) if source else "")
    folder = base / FRAMES if source and source.is_file() else source
    check_unique_name(base, folder, root)
    if source and folder and folder != source:
        update_frames(source, folder, root, hashes)
    found = load_scene_file(folder, pipeline) if folder else SceneFile(root / "scene.yaml", None, {}, {})
    if variant and variant not in pipeline.variants:
        raise Refused(f"{root / 'pipeline.yaml'}: {unknown_name('variant', variant, pipeline.variants)}")
    home = base.with_name(f"{base.name}@{variant}") if variant else base
    profile, why = choose_profile(request.profile, found, [home / "profile", base / "profile"], pipeline, request.cuda)
    if request.compared and profile in pipeline.comparisons:
        profile, why = pipeline.comparisons[profile], f"methods of the profile {profile} are compared in it"
    layer = (pipeline, found, profile, variant, parse_set(request.set, pipeline))
    layers = stack_layers(*layer, {})
    if request.budget or found.budget is not None:
        origin, text = ("budget", request.budget) if request.budget else (str(found.path), found.budget)
        layers = stack_layers(*layer, split_budget(pipeline, layers.values, parse_duration(text, origin)))
    keys = frozenset(found.brings)
    folders, options = (root, runs, folder or root, home, base), (request.keep, request.cuda)
    return ResolvedJob(*folders, pipeline, layers, profile, why, request.trust, keys, hashes, *options)


def choose_profile(
    asked: str | None, scene: SceneFile, pinned: list[Path], pipeline: Pipeline, cuda: bool | None = None
) -> tuple[str, str]:
    """The profile, and why: the one asked for, else of scene.yaml, else of the scene's last run, else by machine."""
    origin = "profile" if asked else f"{scene.path}: profile"
    why = "asked for" if asked else f"{scene.path.name} says so"
    profile = asked or scene.profile or AUTO
    if profile == AUTO:
        origin, profile, why = "profile", "laptop", "no CUDA driver on this machine"
        if record := next((path for path in pinned if read_text(path)), None):
            origin, profile, why = str(record), read_text(record), "this scene was run with it"
        elif cuda:
            profile, why = "paper", "the cluster has GPUs"
        elif cuda is None and has_cuda():
            profile, why = "paper", "this machine has a CUDA driver"
    if profile not in pipeline.profiles:
        raise Refused(f"{origin}: {unknown_name('profile', profile, [AUTO, *pipeline.profiles])}")
    return profile, why


def has_cuda() -> bool:
    """Is there an NVIDIA driver with a visible device? Looks at the system, without importing torch."""
    if os.environ.get("CUDA_VISIBLE_DEVICES", "unset") in ("", "-1"):
        return False
    return any(Path(p).exists() for p in ("/proc/driver/nvidia/version", "/dev/nvidia0", "/usr/lib/wsl/lib/libcuda.so"))


def check_unique_name(base: Path, folder: Path | None, root: Path) -> None:
    """Raise Refused where the artifacts in `base` were made from another scene of the same name."""
    before = root / read_text(base / "source")
    if folder and before not in (root, folder) and before.is_dir():
        raise Refused(
            f"two scenes are called {folder.name!r}: {base} was made from {before}, and {folder} is asked for; "
            f"rename one folder, or make room with `make scene={shlex.quote(str(before))} clean`"
        )


def _questions(job: ResolvedJob) -> dict[str, dict[str, Any]]:
    """Key of the answer -> question, for each stage that has a file; see `worker.describe`."""
    questions = {}
    for stage, spec in job.pipeline.stages.items():
        if (job.root / "stages" / f"{stage}.py").is_file():
            question = {"stage": stage, "params": job.layers.values[stage], "takes": spec.all_needs}
            if SCENE in spec.all_needs and job.folder != job.root:
                question["scene"] = str(job.folder)
            questions[_answer_key(job, question)] = question
    return questions


def _answer_key(job: ResolvedJob, question: dict[str, Any]) -> str:
    """A key that changes with everything that the answer depends on; answers under a CACHED key are cached.

    A process that imports stages takes half a second to start, and so may listing the files that a stage reads."""
    stage, plan, listed = question["stage"], "stages/plan", list_files(job.folder) if "scene" in question else ()
    try:
        folder = plan if (job.root / plan / f"{stage}.py").is_file() else "stages"
        code = code_fingerprints(job.root, stage, job.hashes, folder)
        code["run"] = job.hashes.module(job.root / "stages" / f"{stage}.py", job.root)[0]
    except Refused:  # not valid Python: reported as broken
        return json.dumps(question)
    if "scene" in question and any(paths_outside(question["params"], job.folder)):
        return json.dumps(question)  # the answer may depend on files outside the scene
    files = [(str(path), (stat := path.stat()).st_size, stat.st_mtime_ns) for path in listed]
    return CACHED + digest(json.dumps([question, code, job.hashes.file(WORKER), files]))


def _add_descriptions(job: ResolvedJob, questions: dict[str, dict[str, Any]], answers: dict[str, Any]) -> ResolvedJob:
    """The job with the descriptions of its stages. Raises Refused for the first parameter that is wrong."""
    broken = {name: f"stages/{name}.py: no such file, and pipeline.yaml names it" for name in job.pipeline.stages}
    stages = {}
    for name, question in questions.items():
        stage, answer = question["stage"], answers[name]
        for error in answer.get("errors", ()):
            origin = job.layers.origin(stage, error["where"])
            raise Refused(f"{origin}: {_refusal(stage, error, answer['known'])}")
        if "broken" in answer:
            broken[stage] = answer["broken"]
        else:
            stages[stage] = StageInfo(**answer)
            del broken[stage]
    return replace(job, stages=stages, broken=broken)


def _refusal(stage: str, error: dict[str, Any], known: list[str]) -> str:
    """The message for a parameter that is wrong."""
    if error["unknown"]:
        return f"stage {stage}: {unknown_name('parameter', error['where'], known)}"
    return f"{stage}.{error['where']} = {error['value']}: {error['message']}"
