"""The first step: a request becomes a job, in which everything is settled and checked."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from runner import Refused
from runner.describe import Described, ask, described, questions
from runner.keys import Hashes
from runner.layers import Layers, layered, parse_set, seconds_of, shared_out
from runner.pipeline import Pipeline, SceneFile, find_scene, load_pipeline, load_scene_file, unknown

AUTO = "auto"  # the profile that this machine can do


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


class Memory:
    """What the jobs of one command share: hashes of files, and `answers` of stages, until a stage has run."""

    def __init__(self, runs: Path):
        self.hashes = Hashes(runs / ".hashes.json")
        self.answers: dict[str, Any] = {}


@dataclass(frozen=True)
class Job:
    """One scene with everything about it resolved and checked.

    Attributes:
        folder: of the scene.
        home: runs/<scene>, or runs/<scene>@<variant>.
        why: what made the choice of the profile.
        brings: the keys of scene.yaml that have values.
        stages: stage -> its parameters, and what else it says of itself.
        broken: stages that are not among these, because their file is missing or is no stage -> what is wrong.
    """

    root: Path
    runs: Path
    folder: Path
    home: Path
    pipeline: Pipeline
    profile: str
    why: str
    trust: bool
    brings: frozenset[str]
    memory: Memory
    stages: dict[str, Described] = field(default_factory=dict)
    broken: dict[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The scene's."""
        return self.folder.name

    @property
    def label(self) -> str:
        """The scene's name with its variant's."""
        return self.home.name

    @property
    def base(self) -> Path:
        """runs/<scene>: what a variant shares lies there."""
        return self.runs / self.name

    @property
    def hashes(self) -> Hashes:
        return self.memory.hashes

    @property
    def params(self) -> dict[str, dict[str, Any]]:
        """stage -> every parameter."""
        return {stage: each.params for stage, each in self.stages.items()}


def resolve(request: Request, memory: Memory | None = None) -> Job:
    """Read and check everything a request names. Raises Refused with one line that says what would fix it."""
    return resolve_all([request], memory or Memory(request.runs))[0]


def resolve_all(requests: list[Request], memory: Memory) -> list[Job]:
    """The same for each, with one process that asks the stages for all."""
    drafts = [_draft(request, memory) for request in requests]
    asked = [questions(j.root, j.pipeline, layers, brought(j.brings, j.folder), j.folder) for j, layers in drafts]
    if requests:
        ask(requests[0].root, [question for each in asked for question in each], memory.answers)
    jobs = []
    for (job, layers), own in zip(drafts, asked, strict=True):
        stages, broken = described(job.root, job.pipeline, layers, own, memory.answers)
        jobs.append(replace(job, stages=stages, broken=broken))
    return jobs


def _draft(request: Request, memory: Memory) -> tuple[Job, Layers]:
    """A job that does not know its stages yet, and the parameters that are asked for."""
    root, runs = request.root, request.runs
    pipeline = load_pipeline(root)
    folder = find_scene(request.scene, root)
    scene = load_scene_file(folder, pipeline)
    base = runs / folder.name
    home = base.with_name(f"{base.name}@{request.variant}") if request.variant else base
    profile, why, layers = settled(request, pipeline, scene, [home / "profile", base / "profile"])
    _one_folder_a_name(base, folder, root)
    keys = frozenset(scene.brings)
    return Job(root, runs, folder, home, pipeline, profile, why, request.trust, keys, memory), layers


def settled(request: Request, pipeline: Pipeline, scene: SceneFile, pinned: list[Path]) -> tuple[str, str, Layers]:
    """The profile, why it was chosen, and the parameters that are asked for, shares of a budget among them."""
    if request.variant and request.variant not in pipeline.variants:
        raise Refused(f"{request.root / 'pipeline.yaml'}: {unknown('variant', request.variant, pipeline.variants)}")
    profile, why = choose_profile(request.profile, scene, pinned, pipeline)
    given = (pipeline, scene, profile, request.variant, parse_set(request.set, pipeline))
    layers = layered(*given, {})
    if request.budget or scene.budget is not None:
        origin, text = ("budget", request.budget) if request.budget else (str(scene.path), scene.budget)
        layers = layered(*given, shared_out(pipeline, layers.values, seconds_of(text, origin)))
    return profile, why, layers


def choose_profile(asked: str | None, scene: SceneFile, pinned: list[Path], pipeline: Pipeline) -> tuple[str, str]:
    """The profile asked for, else scene.yaml's, else the one this scene was run with, else by the machine; and why."""
    origin = "profile" if asked else f"{scene.path}: profile"
    why = "asked for" if asked else f"{scene.path.name} says so"
    profile = asked or scene.profile or AUTO
    if profile == AUTO:
        origin, profile, why = "profile", "laptop", "no CUDA driver on this machine"
        if record := next((path for path in pinned if path.is_file()), None):
            origin, profile, why = str(record), record.read_text().strip(), "this scene was run with it"
        elif has_cuda():
            profile, why = "paper", "this machine has a CUDA driver"
    if profile not in pipeline.profiles:
        raise Refused(f"{origin}: {unknown('profile', profile, [AUTO, *pipeline.profiles])}")
    return profile, why


def has_cuda() -> bool:
    """Is there an NVIDIA driver, and is a device visible? Asked of the system, so that torch need not be imported."""
    if os.environ.get("CUDA_VISIBLE_DEVICES", "unset") in ("", "-1"):
        return False
    return any(Path(p).exists() for p in ("/proc/driver/nvidia/version", "/dev/nvidia0", "/usr/lib/wsl/lib/libcuda.so"))


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
