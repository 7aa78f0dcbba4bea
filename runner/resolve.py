"""The first step of the runner: turns a request into a job, with everything that it names read and checked.

Terms are explained in `runner`.
"""

import json
import os
import shlex
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from reffusion.command import scene_name
from runner import Refused
from runner.files import list_files, read_text
from runner.frames import FRAMES, update_frames
from runner.keys import HASHES, Hashes, code_fingerprints, digest, files_outside, flatten_params, paths_outside
from runner.parameters import Layers, parse_duration, parse_set, split_budget, stack_layers
from runner.pipeline import SCENE, Pipeline, SceneFile, check_known, find_scene, load_pipeline, load_scene_file
from runner.process import ask_stages
from runner.text import unknown_name

AUTO = "auto"  # stands for the profile that suits this machine
WORKER = Path(__file__).with_name("worker.py")


@dataclass(frozen=True)
class Request:
    """The options of a command line.

    Attributes:
        root: folder with pipeline.yaml and stages/.
        runs: folder of all results.
        scene: name or path of the scene; "" for none.
        profile: name of the profile, or "auto"; None if not given.
        variant: name of the variant; None for the scene's own run.
        trust: True accepts artifacts that only differ by their code.
        set: parameters, see `parameters.parse_set`.
        budget: time budget as text; None if not given.
        keep: True accepts artifacts that people changed, and records this in their receipts.
        cuda: whether the cluster has GPUs; None if stages run on this machine, see `has_cuda`.
        compared: True uses the profile that `comparisons` of pipeline.yaml names for the scene's profile, if any.
        gpu: name of another machine's GPU, for which expected durations are computed; None for this machine's.
    """

    root: Path
    runs: Path
    scene: str
    profile: str | None = None
    variant: str | None = None
    trust: bool = False
    set: str = ""
    budget: str | None = None
    keep: bool = False
    cuda: bool | None = None
    compared: bool = False
    gpu: str | None = None


@dataclass(frozen=True)
class StageInfo:
    """The description of a stage with given parameters, as the stage's own code gives it.

    Attributes:
        params: all parameters, defaults included; groups are nested dicts.
        weights: dotted names of the parameters that name weights.
        unkeyed: dotted names of the parameters that do not change the artifact.
        programs: dotted names of the parameters that name a program to run.
        reads: paths of the files of the scene that the stage reads; None for all.
        facts: facts about the scene on which the artifact depends besides the files in `reads`, e.g. names of files.
        machine: facts about this machine on which the artifact depends.
        unavailable: optional features, such as LPIPS, that this machine does not have.
        broken: why the stage cannot be imported; then nothing else is known.
    """

    params: dict[str, Any] = field(default_factory=dict)
    weights: tuple[str, ...] = ()
    unkeyed: tuple[str, ...] = ()
    programs: tuple[str, ...] = ()
    reads: tuple[str, ...] | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    machine: dict[str, str] = field(default_factory=dict)
    unavailable: tuple[str, ...] = ()
    broken: str = ""


@dataclass(frozen=True, kw_only=True)
class ResolvedJob(Request):
    """A job: one scene, or a variant of it, with all its settings, resolved and checked.

    Attributes:
        folder: the scene's folder; the root for a job without a scene.
        base: folder of the scene's own run, runs/<scene>, whose artifacts variants share.
        pipeline: the content of pipeline.yaml.
        layers: the parameters as the user and the files ask for them, without the defaults in the stages' code.
        profile: name of the profile.
        why: the reason for this profile, in words.
        brings: the keys of scene.yaml that describe the scene and have values.
        hashes: the cache of hashes.
        stages: stage -> its description.
    """

    folder: Path
    base: Path
    pipeline: Pipeline
    layers: Layers
    profile: str
    why: str
    brings: frozenset[str]
    hashes: Hashes
    stages: dict[str, StageInfo] = field(default_factory=dict)

    @property
    def home(self) -> Path:
        """The folder of this run, runs/<scene> or runs/<scene>@<variant>."""
        return variant_folder(self.base, self.variant)

    @property
    def params(self) -> dict[str, dict[str, Any]]:
        """Stage -> all its parameters, defaults included; groups are nested dicts."""
        return {stage: each.params for stage, each in self.stages.items()}

    def paths_outside(self, stage: str) -> list[Path]:
        """Return the paths outside the scene's folder that a stage reads; scene.yaml or capture files name them."""
        info = self.stages[stage]
        if info.reads is not None:
            return files_outside(info.reads, self.folder)
        takes_scene = SCENE in self.pipeline.stages[stage].all_needs
        return list(paths_outside(info.params, self.folder)) if takes_scene else []

    def question(self, stage: str) -> dict[str, Any]:
        """Build the question to a stage about its parameters, see `worker.describe`."""
        takes = self.pipeline.stages[stage].all_needs
        return {"stage": stage, "params": self.layers.values[stage], "takes": takes}

    def weights_question(self, stage: str) -> dict[str, Any]:
        """Build the question to a stage about its parameters and the weights that it needs, see `worker.describe`.

        The weights depend on what the scene brings, so the question has the keys of scene.yaml and the names of the
        scene's folders. The answer is not cached, because weights may be downloaded or removed at any time.
        """
        folders = [path.name for path in self.folder.iterdir() if path.is_dir()] if self.folder != self.root else ()
        return self.question(stage) | {"brings": sorted({*self.brings, *folders})}


def resolve(request: Request, hashes: Hashes | None = None, scene: bool = True) -> ResolvedJob:
    """Read and check everything that a request names. If the scene is a video, its frames are extracted.

    Args:
        request: the request.
        hashes: the cache of hashes; None reads it from runs/.
        scene: False for a job without a scene, such as the download of weights.

    Raises:
        Refused: something is wrong; the message says how to correct it.
    """
    return resolve_all([request], hashes or Hashes(request.runs / HASHES), scene)[0]


def resolve_all(requests: list[Request], hashes: Hashes, scene: bool = True) -> list[ResolvedJob]:
    """Resolve at least one request, all of the same root, and return the jobs in the same order.

    All questions to stages whose answers are not in the cache are sent to one process. For the arguments and errors see
    `resolve`.
    """
    drafts = [_draft(request, hashes, scene) for request in requests]
    questions = [_questions(job) for job in drafts]
    new = {name: question for each in questions for name, question in each.items() if name not in hashes.known}
    answers = dict(zip(new, ask_stages(requests[0].root, list(new.values())), strict=True))
    hashes.known |= {key: answer for key, answer in answers.items() if _is_lasting(new[key], answer)}
    return [_add_descriptions(job, each, hashes.known | answers) for job, each in zip(drafts, questions, strict=True)]


def _draft(request: Request, hashes: Hashes, scene: bool) -> ResolvedJob:
    """Resolve everything of a request but the descriptions of the stages; for the arguments see `resolve`."""
    root, variant, pipeline = request.root, request.variant, load_pipeline(request.root)
    base, folder, found = request.runs, root, SceneFile(root / "scene.yaml", None, {}, {})
    if scene:
        source = find_scene(request.scene, root)
        base = request.runs / scene_name(source)
        folder = base / FRAMES if source.is_file() else source
        check_unique_name(base, folder, root)
        if source.is_file():
            update_frames(source, folder, root, hashes)
        found = load_scene_file(folder, pipeline)
    check_known(f"gpu={request.gpu}", "GPU", request.gpu or None, pipeline.gpus)
    check_known(str(root / "pipeline.yaml"), "variant", variant or None, pipeline.variants)
    pinned = [home / "profile" for home in (variant_folder(base, variant), base)]
    profile, why = choose_profile(request.profile, found, pinned, pipeline, request.cuda)
    if request.compared and profile in pipeline.comparisons:
        profile, why = pipeline.comparisons[profile], f"methods of the profile {profile} are compared in it"
    layer = (pipeline, found, profile, variant, parse_set(request.set, pipeline))
    layers = stack_layers(*layer, {})
    if request.budget or found.budget is not None:
        origin, text = ("budget", request.budget) if request.budget else (str(found.path), found.budget)
        layers = stack_layers(*layer, split_budget(pipeline, layers.values, parse_duration(text, origin)))
    settings = {"folder": folder, "base": base, "pipeline": pipeline, "layers": layers, "hashes": hashes}
    settings |= {"profile": profile, "why": why, "brings": frozenset(found.brings)}
    return ResolvedJob(**vars(request) | settings)


def choose_profile(
    asked: str | None, scene: SceneFile, pinned: list[Path], pipeline: Pipeline, cuda: bool | None = None
) -> tuple[str, str]:
    """Choose the profile: the one asked for, else that of scene.yaml, else that of the last run, else by the machine.

    The name "auto", asked for or in scene.yaml, stands for the last two. By the machine the profile is "paper" with a
    GPU, else "laptop".

    Args:
        asked: the option `profile`, which precedes that of scene.yaml; None if not given.
        scene: the content of scene.yaml.
        pinned: files that record the profile of the last run; the first one with a text counts.
        cuda: as in `Request`.

    Returns:
        Name of the profile, and the reason for it in words.

    Raises:
        Refused: the profile is unknown.
    """
    origin = "profile" if asked else f"{scene.path}: profile"
    why = "asked for" if asked else f"{scene.path.name} says so"
    profile = asked or scene.profile or AUTO
    if profile == AUTO:
        origin, profile, why = "profile", "laptop", "no CUDA driver on this machine"
        if record := next((path for path in pinned if read_text(path)), None):
            origin, profile, why = str(record), read_text(record), "this scene was run with it"
        elif has_cuda() if cuda is None else cuda:
            profile, why = "paper", "this machine has a CUDA driver" if cuda is None else "the cluster has GPUs"
    if profile not in pipeline.profiles:
        raise Refused(f"{origin}: {unknown_name('profile', profile, [AUTO, *pipeline.profiles])}")
    return profile, why


def has_cuda() -> bool:
    """Return whether this machine has an NVIDIA driver and CUDA_VISIBLE_DEVICES does not hide all devices.

    Only files of the system are looked at; torch is not imported.
    """
    if os.environ.get("CUDA_VISIBLE_DEVICES", "unset") in ("", "-1"):
        return False
    return any(Path(p).exists() for p in ("/proc/driver/nvidia/version", "/dev/nvidia0", "/usr/lib/wsl/lib/libcuda.so"))


def variant_folder(base: Path, variant: str | None) -> Path:
    """Return the folder of a variant's run beside that of the scene's own run, `base`; None stands for the latter."""
    return base.with_name(f"{base.name}@{variant}") if variant else base


def check_unique_name(base: Path, folder: Path, root: Path) -> None:
    """Raise Refused if the artifacts in `base` were made from another scene with the same name.

    Args:
        base: folder of the scene's artifacts, runs/<scene>.
        folder: folder of the scene.
        root: folder with pipeline.yaml.
    """
    before = root / read_text(base / "source")
    if before not in (root, folder) and before.is_dir():
        raise Refused(
            f"two scenes are called {folder.name!r}: {base} was made from {before}, and {folder} is asked for; "
            f"rename one folder, or make room with `make scene={shlex.quote(str(before))} clean`"
        )


def _questions(job: ResolvedJob) -> dict[str, dict[str, Any]]:
    """Return the questions to all stages, see `worker.describe`, by the keys of `_answer_key`."""
    questions = {}
    for question in map(job.question, job.pipeline.stages):
        if SCENE in question["takes"] and job.folder != job.root:
            question["scene"] = str(job.folder)
        questions[_answer_key(job, question)] = question
    return questions


def _answer_key(job: ResolvedJob, question: dict[str, Any]) -> str:
    """Return the key in the cache of a question's answer: a hash of the question, of code, and of the scene's files."""
    stage = question["stage"]
    folder = "stages/plan" if (job.root / "stages/plan" / f"{stage}.py").is_file() else "stages"
    try:
        code = code_fingerprints(job.root, stage, job.hashes, folder)
        code["run"] = job.hashes.module(job.root / "stages" / f"{stage}.py", job.root)[0]
    except (Refused, OSError) as error:  # not valid Python, or no file, which no plan accepts
        code = {"error": str(error)}
    listed = list_files(job.folder) if "scene" in question else ()
    files = [(str(path), (stat := path.stat()).st_size, stat.st_mtime_ns) for path in listed]
    return "answer " + digest(json.dumps([question, code, job.hashes.file(WORKER), files]))


def _is_lasting(question: dict[str, Any], answer: dict[str, Any]) -> bool:
    """Return whether an answer depends on nothing that its key leaves out: this machine, and files outside the scene.

    Caching such answers saves a process, which takes half a second to start, and as much to find the files.
    """
    if "params" not in answer or answer.get("machine") or answer.get("unavailable"):
        return False
    scene = Path(question.get("scene", "/"))  # without a scene no path is outside
    return not files_outside(answer.get("reads", ()), scene) and not any(paths_outside(question["params"], scene))


def _add_descriptions(job: ResolvedJob, questions: dict[str, dict[str, Any]], answers: dict[str, Any]) -> ResolvedJob:
    """Add the stages' descriptions from `answers` (by key) to a job; raises Refused for the first wrong parameter."""
    stages = {}
    for name, question in questions.items():
        stage, answer = question["stage"], answers[name]
        for error in answer.get("errors", ()):
            origin = job.layers.origin(stage, error["where"])
            wrong = f"{stage}.{error['where']} = {error['value']}: {error['message']}"
            if error["unknown"]:
                wrong = f"stage {stage}: {unknown_name('parameter', error['where'], answer['known'])}"
            raise Refused(f"{origin}: {wrong}")
        stages[stage] = StageInfo(**answer)
        _refuse_programs_of_scene(job, stage, stages[stage])
    return replace(job, stages=stages)


def _refuse_programs_of_scene(job: ResolvedJob, stage: str, info: StageInfo) -> None:
    """Raise Refused if scene.yaml, which people get from others together with photographs, names a program to run."""
    for name in info.programs:
        origin, program = job.layers.origin(stage, name), flatten_params(info.params)[name]
        if program and origin.startswith(str(job.folder / "scene.yaml")):
            raise Refused(
                f"{origin}: it names a program to run ({program!r:.80}), which a scene may not do; if you trust it, "
                f'remove it there and give it by set="{stage}.{name}=..."'
            )
