"""The third step of the runner: runs the stages of a plan, each in a new process.

A stage works in a folder of its own, which is renamed to its final place when the stage is done. Terms are explained in
`runner`.
"""

import errno
import importlib.metadata
import json
import platform
import shutil
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from runner import Failed, Refused, artifacts, files, say
from runner.durations import format_total_time, seconds_by_stage, typical_seconds
from runner.files import RECEIPT, read_json, read_receipt, write_json, write_text
from runner.keys import Hashes, Inputs
from runner.pipeline import SCENE
from runner.plan import Decision, decide, partial_folder, plan, used_needs
from runner.plan_table import plan_table
from runner.process import Engine, Resources, StageResult, Task, ThisMachine
from runner.resolve import Request, ResolvedJob, resolve
from runner.text import REMEDIES, display_path, format_seconds

# packages whose versions a receipt records
PACKAGES = ("reffusion", "numpy", "torch", "numba", "diffusers", "transformers", "peft", "pycolmap", "gsplat")
FULL_DISK_BYTES = 2**20  # a disk with less free space counts as full


@dataclass(frozen=True)
class Execution:
    """Settings for the execution of stages.

    Attributes:
        engine: the engine that runs the stages.
        cores: number of cores of each stage. None for an equal part of the engine's cores if several scenes run; else
            for all cores of this machine, or for one core on a cluster.
        gpu_cores: number of cores of each stage that has a GPU; None for `cores`.
        output: the file to which stages append what they print; None for the runner's own output.
        on_change: called with the name of a stage and its new state: "waits" (for cores, GPUs or memory), "runs" or
            "done". A stage that need not run is done at once.
        memory_mb: called with the job, a stage and the folders of its needs; returns the memory to reserve, MB.
    """

    engine: Engine = field(default_factory=ThisMachine)
    cores: int | None = None
    gpu_cores: int | None = None
    output: Path | None = None
    on_change: Callable[[str, str], None] = lambda stage, state: None
    memory_mb: Callable[[ResolvedJob, str, dict[str, Path | None]], int] = lambda job, stage, needs: 0


def _run_stage(
    job: ResolvedJob, stage: str, time_left: str, decisions: dict[str, Decision], lock: int, execution: Execution
) -> Decision:
    """Run one stage or copy its artifact, move the artifact into place, return `cached`; raises Failed if it fails."""
    decision, place, interrupted = decisions[stage], job.home / stage, False
    assert decision.inputs
    # If an interrupted run with the same key left this folder, the stage resumes from its state.
    partial = partial_folder(job, stage, decision.inputs.key)
    artifacts.restore_from_attempt(partial)
    if not partial.exists() and (other := _copy_from_variant(job, stage, decision.inputs.key, partial)):
        say(f"{stage}: the same as in {other}: copied")
    if not read_receipt(partial):  # a receipt is there if it was copied, or the runner was killed before the renames
        resumed = partial.exists()
        partial.mkdir(parents=True, exist_ok=True)
        say(f"{stage}: {decision.reason}{time_left}")
        result = _run_in_engine(execution, job, stage, partial, decisions, lock)
        interrupted = result.interrupted
        say(f"{stage}: done in {result.answer['seconds']:.1f} s, {result.answer['peak_memory_mb']} MB")
        files.check_lock(lock)
        answer = {"resumed": resumed} | result.answer  # its seconds are of the last try only
        write_json(partial / RECEIPT, _receipt(job, stage, decision.inputs, partial, answer))
    files.export_folders(partial, place, job.home, job.pipeline.stages[stage].export)
    artifacts.replace_artifact(partial, place, job.hashes)
    for abandoned in job.home.glob(f".partial-{stage}-*"):
        artifacts.delete_folder(abandoned)
    job.hashes.save()
    if interrupted:
        raise KeyboardInterrupt
    return replace(decision, status="cached", reason="made now", path=place, is_final=True)


def _time_left(stage: str, seconds: dict[str, float | None]) -> str:
    """Return "; about <time>, <total> to the end" for a stage and all in `seconds`; "" if the stage's is unknown."""
    if (own := seconds.get(stage)) is None:
        return ""
    return f"; about {format_seconds(own)}" + (f", {format_total_time(seconds)} to the end" if len(seconds) > 1 else "")


def _copy_from_variant(job: ResolvedJob, stage: str, key: str, to: Path) -> str | None:
    """Copy an undamaged artifact with this key from another variant of the scene; return its folder's name, or None."""
    for home in sorted(job.runs.glob(f"{job.base.name}@*")):
        if home != job.home and (read_receipt(home / stage) or {}).get("key") == key:
            with suppress(Refused), files.hold_lock(job.runs, home.name, shared=True, wait=False):
                copy, found = job.home / f".copying-{stage}", read_receipt(home / stage)
                artifacts.delete_folder(copy)
                if found and found["key"] == key and not artifacts.diff_artifact(home / stage, job.hashes).describe():
                    shutil.copytree(home / stage, copy)
                    copy.rename(to)
                    return home.name
    return None


def _run_in_engine(
    execution: Execution, job: ResolvedJob, stage: str, partial: Path, decisions: dict[str, Decision], lock: int
) -> StageResult:
    """Run a stage's process by the engine, and return its result; raises Failed or KeyboardInterrupt."""
    log = job.home / f"{stage}.log"
    needs = dict.fromkeys(job.pipeline.stages[stage].all_needs)
    needs |= {need: job.folder if need == SCENE else decisions[need].path for need in used_needs(job, stage)}
    line = {"stage": stage, "params": job.params[stage], "out": partial, "log": log, "needs": needs}
    task = Task(job.root, json.loads(json.dumps(line, default=str)), execution.output)
    gpus = int(job.params[stage].get("device") == "cuda")
    cores = (gpus and execution.gpu_cores) or execution.cores
    execution.on_change(stage, "waits")
    resources = Resources(cores, gpus, execution.memory_mb(job, stage, needs))
    result = execution.engine.run(task, resources, lock, lambda: execution.on_change(stage, "runs"))
    if result.code == 0 and result.answer:
        return result
    how = f"ended with code {result.code}"
    if result.code < 0:
        how = f"ended by signal {-result.code} ({signal.Signals(-result.code).name})"
        how += "; out of memory?" * (result.code == -signal.SIGKILL)
    error = result.answer.get("error", how)
    is_full = shutil.disk_usage(job.home).free < FULL_DISK_BYTES
    if is_full and REMEDIES[errno.ENOSPC] not in error:  # many libraries do not say that the disk is full
        error += f"; the disk is full: {REMEDIES[errno.ENOSPC]}"
    raise Failed(f"{stage}: {error} (all of it in {display_path(log)})")


def _receipt(job: ResolvedJob, stage: str, inputs: Inputs, folder: Path, result: dict[str, Any]) -> dict[str, Any]:
    """Return the receipt of a finished stage whose files are in `folder`; `result` is added to it."""
    return {
        "stage": stage,
        "scene": job.base.name,
        "key": inputs.key,
        **asdict(inputs),
        "profile": job.profile,
        **artifacts.hash_contents(folder, job.hashes),
        "versions": _versions(),
        "platform": platform.platform(),
        "device": job.params[stage].get("device", "cpu"),
        "typical_seconds": typical_seconds(job, stage),
        **result,
        "date": time.strftime("%FT%T%z"),
    }


def _versions() -> dict[str, str]:
    """Return the versions of Python and of the installed packages among `PACKAGES`."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def run_scene(
    request: Request, target: str, hashes: Hashes | None = None, execution: Execution | None = None
) -> dict[str, Path | None]:
    """Run a stage of a scene and the stages that it needs, as far as artifacts are not up to date. Prints the plan.

    Also writes the profile and the source of the scene to its folder in runs/, and prints warnings of cached stages.

    Args:
        request: the scene and its options.
        target: name of the stage; "all" for all stages.
        hashes: the cache of hashes; None reads it from runs/.
        execution: settings; None for this machine with all its cores.

    Returns:
        Stage -> folder of its artifact, or None if the stage is skipped, for `target`, which comes last, and all stages
        that `target` needs. A variant's folder may be that of the scene's own run.

    Raises:
        Refused: something that the user can correct is wrong or missing. Mostly this is raised before any stage runs.
        Failed: a stage fails.
    """
    execution = execution or Execution()
    job = resolve(request, hashes)
    stages = job.pipeline.closure(target)
    with ExitStack() as locks:
        if job.home != job.base:
            locks.enter_context(files.hold_lock(job.runs, job.base.name, shared=True))
        lock = locks.enter_context(files.hold_lock(job.runs, job.home.name))
        job.home.mkdir(parents=True, exist_ok=True)
        artifacts.recover_swap(job.home, job.hashes)
        planned = _plan_rest(job, stages, {})
        write_text(job.home / "profile", job.profile + "\n")
        inside = job.folder.is_relative_to(job.root)  # the path of such a scene is recorded relative to the root
        write_text(job.home / "source", f"{job.folder.relative_to(job.root) if inside else job.folder}\n")
        done: dict[str, Decision] = {}
        for position, stage in enumerate(stages):
            done[stage] = decide(job, stage, done)
            if done[stage].status == "cached":
                if job.keep and done[stage].path == job.home / stage:
                    artifacts.accept_changes(job.home / stage, job.hashes)
                for warning in read_json(done[stage].path / "warnings.json") or ():  # a stage that runs prints its own
                    say(f"warning: {warning}")
            elif done[stage].status == "run":
                seconds = seconds_by_stage(job, {later: planned[later] for later in stages[position:]})
                done[stage] = _run_stage(job, stage, _time_left(stage, seconds), done, lock, execution)
                if any(planned[later].status == "pending" for later in stages[position + 1 :]):
                    planned = _plan_rest(job, stages, done)
            execution.on_change(stage, "done")
        job.hashes.save()
    return {stage: decision.path for stage, decision in done.items()}


def _plan_rest(job: ResolvedJob, stages: list[str], done: dict[str, Decision]) -> dict[str, Decision]:
    """Plan the stages not in `done`; print the plan if none is done or none is pending; raise Refused if one lacks."""
    planned = plan(job, stages, done)
    rest = {stage: decision for stage, decision in planned.items() if stage not in done}
    if not done or not any(decision.status == "pending" for decision in rest.values()):
        say(plan_table(job, rest))
    for stage, decision in rest.items():
        if decision.status == "missing":
            raise Refused(f"{job.home.name}: {stage}: {decision.reason}")
    return rest
