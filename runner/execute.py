"""The third step: does what a plan asks for, in a fresh process a stage, and renames folders into place."""

import errno
import functools
import importlib.metadata
import json
import platform
import shutil
import signal
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from runner import Failed, Refused, say
from runner.artifacts import accept, contents, discard, put_in_place, recover, wear
from runner.engine import Engine, Local, Needs, Task
from runner.files import (
    CURES,
    MACHINE,
    RECEIPT,
    files_below,
    hand_out,
    locked,
    read_json,
    read_receipt,
    refuse_lost,
    shown,
    write_json,
    write_text,
)
from runner.keys import Hashes, Inputs
from runner.retry import take_over
from runner.pipeline import SCENE
from runner.plan import Decision, amount, decide, expected_seconds, needs_in_use, partial_folder, plan, table
from runner.resolve import Job, Request, ask, child, resolve

PACKAGES = ("reffusion", "numpy", "torch", "numba", "diffusers", "transformers", "peft", "pycolmap", "gsplat")
LITTLE = 2**20  # bytes: a disk with less is full


@dataclass(frozen=True)
class Work:
    """How a job's stages are done. cores: of each of them, None: all there are. output: the file to which what they
    print is added, None: where the runner's own goes. watch: told each stage and what becomes of it, waits, runs, done
    (or it is cached, left out, or provided)."""

    engine: Engine
    cores: int | None = None
    output: Path | None = None
    watch: Callable[[str, str], None] = lambda stage, word: None


def run_stage(
    job: Job, stage: str, decision: Decision, earlier: dict[str, Decision], lock: int, work: Work
) -> Decision:
    """Do the stage in `.partial-<stage>-<key>`, which may hold what an earlier try left, and put it in place."""
    assert decision.inputs
    partial, place = partial_folder(job, stage, decision.inputs.key), job.home / stage
    take_over(partial)
    if not partial.exists() and (other := copied_from_variant(job, stage, decision.inputs.key, partial)):
        say(f"{stage}: the same as in {other}: copied")
    if not read_receipt(partial):  # it is there where the runner was killed just before the swap
        resumed = partial.exists()
        partial.mkdir(parents=True, exist_ok=True)
        seconds = expected_seconds(job, stage)
        say(f"{stage}: {decision.reason}" + (f"; about {seconds:.0f} s" if seconds is not None else ""))
        result = {"resumed": resumed} | _done_by(
            work, job, stage, partial, earlier, lock
        )  # the last try's seconds only
        say(f"{stage}: done in {result['seconds']:.1f} s, {result['peak_memory_mb']} MB")
        refuse_lost(lock)
        write_json(partial / RECEIPT, _receipt(job, stage, decision.inputs, partial, result))
    for line in hand_out(partial, place, job.home, job.pipeline.stages[stage].hands_out):
        say(line)
    put_in_place(partial, place, job.hashes)
    for other in job.home.glob(f".partial-{stage}-*"):
        discard(other)
    job.hashes.save()
    return replace(decision, word="cached", reason="made now", path=place, settled=True)


def copied_from_variant(job: Job, stage: str, key: str, to: Path) -> str | None:
    """Where another variant of the scene has done this very work, copy it; that variant's folder, or None."""
    for home in sorted(job.runs.glob(f"{job.base.name}@*")):
        if home != job.home and (read_receipt(home / stage) or {}).get("key") == key:
            with suppress(Refused), locked(job.runs, home.name, shared=True, wait=False):
                copy, found = job.home / f".copying-{stage}", read_receipt(home / stage)
                discard(copy)
                if found and found["key"] == key and not wear(home / stage, job.hashes).words():
                    shutil.copytree(home / stage, copy)
                    copy.rename(to)
                    return home.name
    return None


def _done_by(
    work: Work, job: Job, stage: str, partial: Path, earlier: dict[str, Decision], lock: int
) -> dict[str, Any]:
    """The result the stage's process told. Raises Failed with its error, KeyboardInterrupt where it was interrupted."""
    log = job.home / f"{stage}.log"
    needs = dict.fromkeys(job.pipeline.stages[stage].takes)
    needs |= {need: job.folder if need == SCENE else earlier[need].path for need in needs_in_use(job, stage)}
    line = {"stage": stage, "params": job.params[stage], "out": partial, "log": log, "needs": needs}
    task = Task(job.root, json.loads(json.dumps(line, default=str)), work.output)
    wanted = Needs(work.cores, int(job.params[stage].get("device") == "cuda"), memory_of(job, stage, needs))
    work.watch(stage, "waits")
    ended = work.engine.run(task, wanted, lock, lambda: work.watch(stage, "runs"))
    code, answer = ended.code, ended.answer
    if code == 0 and answer:
        return answer
    how = f"ended by signal {-code} ({signal.Signals(-code).name})" if code < 0 else f"ended with code {code}"
    hint = "; out of memory?" if code == -signal.SIGKILL else ""
    said = answer.get("error", how + hint)
    if shutil.disk_usage(job.home).free < LITTLE and CURES[errno.ENOSPC] not in said:  # libraries do not tell
        said += f"; the disk is full: {CURES[errno.ENOSPC]}"
    raise Failed(f"{stage}: {said} (all of it in {shown(log)})")


def memory_of(job: Job, stage: str, needs: dict[str, Path | None]) -> int:
    """MB of the CPU's that a stage may take: a tenth above what it last took for this scene, or a variant of it; where
    it has not run yet by pipeline.yaml's `memory`, from the size of the files that it reads."""
    places = [job.runs / job.base.name, *job.runs.glob(f"{job.base.name}@*")]
    took = [r["peak_memory_mb"] for place in places if (r := read_receipt(place / stage)) and r.get("peak_memory_mb")]
    if took:
        return round(1.1 * max(took))
    each = job.pipeline.memory.get(stage)
    read = (path for folder in needs.values() if folder for path in files_below(folder))
    return round(each.mb + each.each * sum(path.stat().st_size for path in read) / 2**20) if each else 0


def _receipt(job: Job, stage: str, inputs: Inputs, folder: Path, result: dict[str, Any]) -> dict[str, Any]:
    return {
        "stage": stage,
        "scene": job.base.name,
        "key": inputs.key,
        **asdict(inputs),
        "profile": job.profile,
        **contents(folder, job.hashes),
        "versions": {"python": platform.python_version(), **_installed()},
        "platform": platform.platform(),
        "machine": MACHINE,
        "device": job.params[stage].get("device", "cpu"),
        **result,
        "date": time.strftime("%FT%T%z"),
    }


@functools.cache
def _installed() -> dict[str, str]:
    found = {}
    for name in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def run_scene(
    request: Request, target: str, hashes: Hashes | None = None, work: Work | None = None
) -> dict[str, Path | None]:
    """Bring `target` and what it needs up to date; stage -> its artifact's folder, None where it is left out.

    Raises Refused before any work, Failed where a stage fails."""
    work = work or Work(Local())
    job = resolve(request, hashes)
    stages = job.pipeline.closure(target)
    with ExitStack() as held:
        if job.home != job.base:
            held.enter_context(locked(job.runs, job.base.name, shared=True))
        lock = held.enter_context(locked(job.runs, job.home.name))
        job.home.mkdir(parents=True, exist_ok=True)
        recover(job.home, job.hashes)
        planned = plan(job, stages)
        say(table(job, planned))
        refuse_missing(job, planned)
        write_text(job.home / "profile", job.profile + "\n")
        inside = job.folder.is_relative_to(job.root)  # then as seen from there
        write_text(job.home / "source", f"{job.folder.relative_to(job.root) if inside else job.folder}\n")
        done: dict[str, Decision] = {}
        for position, stage in enumerate(stages):
            done[stage] = decide(job, stage, done)
            if job.keep and done[stage].word == "cached" and done[stage].path == job.home / stage:
                accept(job.home / stage, job.hashes)
            if done[stage].word == "cached":  # one that runs says it itself
                for line in read_json(done[stage].path / "warnings.json") or ():
                    say(f"warning: {line}")
            if done[stage].word == "run":
                done[stage] = run_stage(job, stage, done[stage], done, lock, work)
                if any(planned[later].word == "undecided" for later in stages[position + 1 :]):
                    planned = plan(job, stages, done)
                    if not any(planned[later].word == "undecided" for later in stages[position + 1 :]):
                        say(table(job, {later: planned[later] for later in stages[position + 1 :]}))
                    refuse_missing(job, planned)
            work.watch(stage, "done")
        job.hashes.save()
    return {stage: decision.path for stage, decision in done.items()}


def refuse_missing(job: Job, planned: dict[str, Decision]) -> None:
    for stage, decision in planned.items():
        if decision.word == "missing":
            raise Refused(f"{job.home.name}: {stage}: {decision.reason}")


def weights(request: Request, offline: bool) -> int:
    """Show the weights of all stages, of a scene where one is named, and fetch what is missing unless `offline`; how
    many that a stage cannot do without are missing in the end."""
    job = resolve(request, scene=bool(request.scene))
    answers = list(zip(job.stages, ask(job.root, list(map(job.question, job.stages))), strict=True))
    all_needs = [(stage, need) for stage, answer in answers for need in answer.get("needed", ())]
    all_needs += [
        (f"{stage}, if asked for", need | {"optional": True})
        for stage, answer in answers
        for need in answer.get("optional", ())
    ]
    needs = {need["name"]: need for _, need in all_needs}
    users = {name: ", ".join(stage for stage, need in all_needs if need["name"] == name) for name in needs}
    missing = [need for need in needs.values() if need["problem"]]
    to_fetch = [need for need in missing if need["fetched"]]
    print(f"weights of profile {job.profile} ({job.why})")
    for name, need in needs.items():
        state = "here" if not need["problem"] else "to fetch" if need["fetched"] else "not usable"
        print(f"  {state:<10} {amount(need['bytes']):>12}  {name}  ({users[name]})")
    for need in missing:
        if not need["fetched"]:
            print(f"error: {need['problem']}", file=sys.stderr)
    for places in dict.fromkeys(tuple(need.get("looked", ())) for need in missing):
        names = [need["name"] for need in missing if tuple(need.get("looked", ())) == places]
        if places:
            print(f"looked for {', '.join(names)} in {', '.join(places)}")
    unsized = " and what has no known size" if any(need["bytes"] is None for need in to_fetch) else ""
    print(f"to fetch: about {amount(sum(need['bytes'] or 0 for need in to_fetch))}{unsized}", flush=True)
    unusable = len(missing) - len(to_fetch)
    if offline or not to_fetch:
        return unusable + sum(not need["optional"] for need in to_fetch)
    process = child(request.root, "fetch")
    process.communicate(json.dumps({stage: job.question(stage) for stage in job.stages}))
    return unusable + process.returncode
