"""The first step: a request becomes a job, in which everything is settled and checked."""

import json
import os
import shlex
import subprocess
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from runner import Refused, say
from runner.files import files_below, read_json, read_text, shown
from runner.keys import HASHES, Hashes, code_of, digest, elsewhere, outside
from runner.parameters import Layers, layered, parse_set, seconds_of, shared_out
from runner.pipeline import (
    SCENE,
    Pipeline,
    SceneFile,
    find_scene,
    load_pipeline,
    load_scene_file,
    scene_name,
    unknown,
)

AUTO = "auto"  # the profile that this machine can do
WORKER = Path(__file__).with_name("worker.py")
FRAMES, TAKEN = "frames", ("frames.json", "frames.csv")  # in runs/<video>/, and what is written there beside images/
LASTING = "told "  # before the names of answers that are remembered


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
    keep: bool = False
    cuda: bool | None = None  # is there a card where stages run? None: where this runs; see `has_cuda`
    compared: bool = False  # in the profile of pipeline.yaml's `comparisons`


@dataclass(frozen=True)
class Described:
    """What a stage says of itself."""

    params: dict[str, Any]  # every parameter, groups nested
    weights: tuple[str, ...] = ()  # dotted names of the parameters that name weights
    unkeyed: tuple[str, ...] = ()  # and of those that change nothing in the artifact
    reads: tuple[str, ...] | None = None  # the files of the scene that it reads; None for all of them
    facts: dict[str, Any] = field(default_factory=dict)  # what it takes from other files, such as their names
    machine: dict[str, str] = field(default_factory=dict)  # what it depends on of this machine
    unavailable: tuple[str, ...] = ()  # what it can do without, and this machine has not


@dataclass(frozen=True)
class Job:
    """One scene with everything about it resolved and checked."""

    root: Path
    runs: Path
    folder: Path  # of the scene; the root where there is none
    home: Path  # runs/<scene>, or runs/<scene>@<variant>
    base: Path  # runs/<scene>: what a variant shares lies there
    pipeline: Pipeline
    layers: Layers  # the parameters that were asked for
    profile: str
    why: str  # what made the choice of the profile
    trust: bool
    brings: frozenset[str]  # the keys of scene.yaml that have values
    hashes: Hashes
    keep: bool = False  # what people changed in artifacts
    cuda: bool | None = None  # as in Request
    stages: dict[str, Described] = field(default_factory=dict)
    broken: dict[str, str] = field(default_factory=dict)  # stages that cannot be described -> what is wrong

    @property
    def params(self) -> dict[str, dict[str, Any]]:
        """stage -> every parameter."""
        return {stage: each.params for stage, each in self.stages.items()}

    def question(self, stage: str) -> dict[str, Any]:
        """What a stage is asked for the weights it works with: see `child.describe`. They depend on what the scene
        brings of itself, the keys of its scene.yaml and its folders, and come and go."""
        folders = [path.name for path in self.folder.iterdir() if path.is_dir()] if self.folder != self.root else ()
        asked = {"stage": stage, "params": self.stages[stage].params, "takes": self.pipeline.stages[stage].takes}
        return asked | {"brings": sorted({*self.brings, *folders})}


def resolve(request: Request, hashes: Hashes | None = None, scene: bool = True) -> Job:
    """Read and check everything a request names; without `scene` that of no scene in particular.

    Raises Refused with one line that says what would fix it."""
    return resolve_all([request], hashes or Hashes(request.runs / HASHES), scene)[0]


def resolve_all(requests: list[Request], hashes: Hashes, scene: bool = True) -> list[Job]:
    """The same for several of one root. Stages are asked all at once, and only what they have not answered before."""
    drafts = [_draft(request, hashes, scene) for request in requests]
    asked = [_questions(job) for job in drafts]
    new = {name: question for each in asked for name, question in each.items() if name not in hashes.known}
    answers = dict(zip(new, ask(requests[0].root, list(new.values())), strict=True))
    lasting = lambda name, said: (
        name.startswith(LASTING) and "params" in said and not (said.get("unavailable") or said.get("machine"))
    )
    inside = lambda question, said: not any(elsewhere(said.get("reads") or (), Path(question.get("scene", "."))))
    hashes.known |= {n: said for n, said in answers.items() if lasting(n, said) and inside(new[n], said)}
    return [_described(job, each, hashes.known | answers) for job, each in zip(drafts, asked, strict=True)]


def _draft(request: Request, hashes: Hashes, scene: bool) -> Job:
    """A job that does not know its stages yet."""
    root, runs, variant, pipeline = request.root, request.runs, request.variant, load_pipeline(request.root)
    given = find_scene(request.scene, root) if scene else None
    base = runs / (scene_name(given) if given else "")
    folder = base / FRAMES if given and given.is_file() else given
    one_folder_a_name(base, folder, root)
    if folder != given:
        take_frames(given, folder, root, hashes)
    found = load_scene_file(folder, pipeline) if folder else SceneFile(root / "scene.yaml", None, {}, {})
    if variant and variant not in pipeline.variants:
        raise Refused(f"{root / 'pipeline.yaml'}: {unknown('variant', variant, pipeline.variants)}")
    home = base.with_name(f"{base.name}@{variant}") if variant else base
    profile, why = choose_profile(request.profile, found, [home / "profile", base / "profile"], pipeline, request.cuda)
    if request.compared and profile in pipeline.comparisons:
        profile, why = pipeline.comparisons[profile], f"methods of the profile {profile} are compared in it"
    layer = (pipeline, found, profile, variant, parse_set(request.set, pipeline))
    layers = layered(*layer, {})
    if request.budget or found.budget is not None:
        origin, text = ("budget", request.budget) if request.budget else (str(found.path), found.budget)
        layers = layered(*layer, shared_out(pipeline, layers.values, seconds_of(text, origin)))
    keys = frozenset(found.brings)
    return Job(
        root,
        runs,
        folder or root,
        home,
        base,
        pipeline,
        layers,
        profile,
        why,
        request.trust,
        keys,
        hashes,
        request.keep,
        request.cuda,
    )


def choose_profile(
    asked: str | None, scene: SceneFile, pinned: list[Path], pipeline: Pipeline, cuda: bool | None = None
) -> tuple[str, str]:
    """The profile asked for, else scene.yaml's, else the one this scene was run with, else by the machine; and why."""
    origin = "profile" if asked else f"{scene.path}: profile"
    why = "asked for" if asked else f"{scene.path.name} says so"
    profile = asked or scene.profile or AUTO
    if profile == AUTO:
        origin, profile, why = "profile", "laptop", "no CUDA driver on this machine"
        if record := next((path for path in pinned if read_text(path)), None):
            origin, profile, why = str(record), read_text(record), "this scene was run with it"
        elif cuda:
            profile, why = "paper", "the cluster has cards"
        elif cuda is None and has_cuda():
            profile, why = "paper", "this machine has a CUDA driver"
    if profile not in pipeline.profiles:
        raise Refused(f"{origin}: {unknown('profile', profile, [AUTO, *pipeline.profiles])}")
    return profile, why


def has_cuda() -> bool:
    """Is there an NVIDIA driver, and is a device visible? Asked of the system, so that torch need not be imported."""
    if os.environ.get("CUDA_VISIBLE_DEVICES", "unset") in ("", "-1"):
        return False
    return any(Path(p).exists() for p in ("/proc/driver/nvidia/version", "/dev/nvidia0", "/usr/lib/wsl/lib/libcuda.so"))


def one_folder_a_name(base: Path, folder: Path | None, root: Path) -> None:
    before = root / read_text(base / "source")
    if folder and before not in (root, folder) and before.is_dir():
        raise Refused(
            f"two scenes are called {folder.name!r}: {base} was made from {before}, and {folder} is asked for; "
            f"rename one folder, or make room with `make scene={shlex.quote(str(before))} clean`"
        )


def take_frames(video: Path, folder: Path, root: Path, hashes: Hashes) -> None:
    """A video's frames into a scene's folder, unless they are there.

    Raises Refused where it is no such video, or the folder holds frames of another one, or things that people put there
    for these frames as they were."""
    content, taken = hashes.file(video), read_json(folder / TAKEN[0]) or {}
    if taken.get("content") == content:
        return
    ours = [folder / name for name in TAKEN]
    theirs = [path for path in files_below(folder) if path not in ours and path.parent != folder / "images"]
    if taken and (theirs or taken["video"] != str(video)):
        raise Refused(
            f"{shown(folder)} holds frames of another video, {taken['video']} as it was"
            + (f", and {shown(theirs[0])} for them" if theirs else "")
            + "; rename the video, or move that folder away"
        )
    process = child(root, "frames", stdout=subprocess.PIPE)
    said, _ = process.communicate(json.dumps({"video": str(video), "folder": str(folder), "content": content}))
    if process.returncode:
        raise Refused(said.strip() or f"{video}: its frames could not be taken (see above)")
    say(said.strip())


def child(root: Path, *arguments: str, **options: Any) -> subprocess.Popen[str]:
    """A fresh process that may import stages: `python -m runner.worker <arguments>` with `root` first on its path."""
    here = Path(__file__).resolve().parent.parent
    path = os.pathsep.join(filter(None, [str(root), str(here), os.environ.get("PYTHONPATH", "")]))
    command, environment = [sys.executable, "-m", "runner.worker", *arguments], {**os.environ, "PYTHONPATH": path}
    return subprocess.Popen(command, cwd=root, env=environment, stdin=subprocess.PIPE, text=True, **options)


def ask(root: Path, questions: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The answer to each, from one process (none where there is no question): see `child.describe`."""
    if not questions:
        return []
    process = child(root, "describe", stdout=subprocess.PIPE)
    said, _ = process.communicate(json.dumps(questions))
    if process.returncode:
        raise Refused("the stages could not be asked for their parameters (see above)")
    return json.loads(said)


def _questions(job: Job) -> dict[str, dict[str, Any]]:
    """What the stages that have a file are asked (see `child.describe`), each under the name of its answer."""
    questions = {}
    for stage, spec in job.pipeline.stages.items():
        if (job.root / "stages" / f"{stage}.py").is_file():
            question = {"stage": stage, "params": job.layers.values[stage], "takes": spec.takes}
            if SCENE in spec.takes and job.folder != job.root:
                question["scene"] = str(job.folder)
            questions[_name(job, question)] = question
    return questions


def _name(job: Job, question: dict[str, Any]) -> str:
    """The same for as long as nothing changes that decides the answer, which is remembered under a LASTING name: to
    start a process that imports stages takes half a second, and so may finding out which files of a scene one reads."""
    stage, plan, listed = question["stage"], "stages/plan", files_below(job.folder) if "scene" in question else ()
    try:
        code = code_of(job.root, stage, job.hashes, plan if (job.root / plan / f"{stage}.py").is_file() else "stages")
        code["run"] = job.hashes.module(job.root / "stages" / f"{stage}.py", job.root)[0]
    except Refused:  # it is no Python, and is said to be broken
        return json.dumps(question)
    if "scene" in question and any(outside(question["params"], job.folder)):  # its files may have a say
        return json.dumps(question)
    files = [(str(path), (stat := path.stat()).st_size, stat.st_mtime_ns) for path in listed]
    return LASTING + digest(json.dumps([question, code, job.hashes.file(WORKER), files]))


def _described(job: Job, questions: dict[str, dict[str, Any]], answers: dict[str, Any]) -> Job:
    """The job with its stages. Raises Refused for the first parameter that is wrong."""
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
            stages[stage] = Described(**answer)
            del broken[stage]
    return replace(job, stages=stages, broken=broken)


def _refusal(stage: str, error: dict[str, Any], known: list[str]) -> str:
    """What is wrong with a parameter."""
    if error["unknown"]:
        return f"stage {stage}: {unknown('parameter', error['where'], known)}"
    return f"{stage}.{error['where']} = {error['value']}: {error['message']}"
