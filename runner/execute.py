"""Runs what a plan asks for: a fresh process a stage, and folders that are renamed into place."""

from __future__ import annotations

import csv
import fcntl
import functools
import importlib.metadata
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from runner.handout import hand_out
from runner.job import Job, Request, child, prepare, source_of
from runner.pipeline import SCENE, Refused
from runner.plan import MACHINE, RECEIPT, Decision, decide, expected_seconds, partial_folder, plan, receipt, table

PACKAGES = ("reffusion", "numpy", "torch", "numba", "diffusers", "transformers", "peft", "pycolmap", "gsplat")
GRACE = 20.0  # seconds an interrupted stage has to end by itself


class Failed(Exception):
    """A stage could not do its work, told in one line."""


def say(text: str) -> None:
    print(text, flush=True)


# ---------------------------------------------------------------------------------------------- locks and renamings


@contextmanager
def locked(runs: Path, name: str, shared: bool = False, wait: bool = True) -> Iterator[int]:
    """Hold `runs/.locks/<name>`; yields its file descriptor. The system frees it when all who hold it have ended."""
    path = runs / ".locks" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    mode = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    with open(path, "a+") as file:
        try:
            fcntl.flock(file, mode | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = f"{name} is in use by process {file.read().strip() or '?'}"
            if not wait:
                raise Refused(f"{holder}; stop it, or wait for its end") from None
            say(f"{holder}: waiting for its end")
            fcntl.flock(file, mode)
        if not shared:
            file.truncate(0)
            file.write(f"{os.getpid()}\n")
            file.flush()
        yield file.fileno()


def put_in_place(partial: Path, place: Path) -> None:
    """Swap a finished folder in. Killed between the two renamings, `recover` brings the old one back."""
    old = place.with_name(f".old-{place.name}")
    if place.exists():
        discard(old)
        place.rename(old)
    partial.rename(place)
    discard(old)


def recover(home: Path) -> None:
    """Undo or finish the swap in which a runner was killed."""
    for old in home.glob(".old-*"):
        place = home / old.name.removeprefix(".old-")
        if place.exists() or not (old / RECEIPT).exists():
            discard(old)
        else:
            old.rename(place)


def discard(folder: Path) -> None:
    """Delete a folder, its receipt first: what is left of it after a kill is never taken for an artifact."""
    if folder.exists():
        (folder / RECEIPT).unlink(missing_ok=True)
        shutil.rmtree(folder)


def write_json(path: Path, content: Any) -> None:
    partial = path.with_name(path.name + ".writing")
    partial.write_text(json.dumps(content, indent=1) + "\n")
    os.replace(partial, path)


# ------------------------------------------------------------------------------------------------------- one stage


def run_stage(job: Job, stage: str, decision: Decision, earlier: dict[str, Decision], lock: int) -> Decision:
    """Do the stage in `.partial-<stage>-<key>`, which may hold what an earlier try left, and put it in place."""
    assert decision.inputs
    partial, place = partial_folder(job, stage, decision.inputs.key), job.home / stage
    if not partial.exists() and (other := copied_from_variant(job, stage, decision.inputs.key, partial)):
        say(f"{stage}: the same as in {other}: copied")
    if not (partial / RECEIPT).exists():  # it is there where the runner was killed just before the swap
        resumed = partial.exists()
        partial.mkdir(parents=True, exist_ok=True)
        seconds = expected_seconds(job, stage)
        say(f"{stage}: {decision.reason}" + (f"; about {seconds:.0f} s" if seconds is not None else ""))
        result = _in_child(job, stage, partial, earlier, lock)
        say(f"{stage}: done in {result['seconds']:.1f} s, {result['peak_memory_mb']} MB")
        write_json(partial / RECEIPT, _receipt(job, stage, decision, partial, resumed, result))
    for line in hand_out(partial, place, job.home, job.pipeline.stages[stage].hands_out):
        say(line)
    put_in_place(partial, place)
    for other in job.home.glob(f".partial-{stage}-*"):
        discard(other)
    job.hashes.save()
    return replace(decision, word="cached", reason="made now", path=place, settled=True)


def copied_from_variant(job: Job, stage: str, key: str, to: Path) -> str | None:
    """Where another variant of the scene has done this very work, copy it; that variant's folder, or None."""
    for home in sorted(job.runs.glob(f"{job.name}@*")):
        if home != job.home and (receipt(home / stage) or {}).get("key") == key:
            with suppress(Refused), locked(job.runs, home.name, shared=True, wait=False):
                copy, found = job.home / f".copying-{stage}", receipt(home / stage)
                discard(copy)
                if found and found["key"] == key and job.hashes.folder(home / stage) == found["output"]:
                    shutil.copytree(home / stage, copy)
                    copy.rename(to)
                    return home.name
    return None


def _in_child(job: Job, stage: str, partial: Path, earlier: dict[str, Decision], lock: int) -> dict[str, Any]:
    """The result the child wrote. Raises Failed with its error; an interrupt is passed on to it and raised again."""
    result, log = job.home / f".result-{stage}.json", job.home / f"{stage}.log"
    result.unlink(missing_ok=True)
    needs = {need: job.folder if need == SCENE else earlier[need].path for need in job.pipeline.stages[stage].takes}
    task = {
        "stage": stage,
        "params": job.params[stage],
        "out": str(partial),
        "needs": {need: path and str(path) for need, path in needs.items()},
        "log": str(log),
        "result": str(result),
        "lock": lock,
    }
    # A process group of its own: Ctrl-C reaches it once, from here.
    process = child(job.root, "run", pass_fds=(lock,), process_group=0)
    assert process.stdin
    try:
        with suppress(BrokenPipeError):  # a child that is gone already has its code below
            process.stdin.write(json.dumps(task) + "\n")
            process.stdin.flush()  # and left open: the child ends when this process does
        code = process.wait()
    except KeyboardInterrupt:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(GRACE)
        except (subprocess.TimeoutExpired, KeyboardInterrupt):
            process.kill()
            process.wait()
        raise
    finally:
        with suppress(BrokenPipeError):
            process.stdin.close()
    answer = json.loads(result.read_text()) if result.exists() else {}
    result.unlink(missing_ok=True)
    if code == 0:
        return answer
    how = f"ended by signal {-code} ({signal.Signals(-code).name})" if code < 0 else f"ended with code {code}"
    hint = "; out of memory?" if code == -signal.SIGKILL else ""
    raise Failed(f"{stage}: {answer.get('error', how + hint)} (all of it in {shown(log)})")


def _receipt(
    job: Job, stage: str, decision: Decision, folder: Path, resumed: bool, result: dict[str, Any]
) -> dict[str, Any]:
    assert decision.inputs
    return {
        "stage": stage,
        "scene": job.name,
        "key": decision.inputs.key,
        **asdict(decision.inputs),
        "output": job.hashes.folder(folder),
        "versions": {"python": platform.python_version(), **_installed()},
        "platform": platform.platform(),
        "machine": MACHINE,
        "device": job.params[stage].get("device", "cpu"),
        "seconds": result["seconds"],
        "resumed": resumed,  # then `seconds` is the last try's only
        "peak_memory_mb": result["peak_memory_mb"],
        "date": time.strftime("%FT%T%z"),
    }


@functools.cache
def _installed() -> dict[str, str]:
    found = {}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


# ------------------------------------------------------------------------------------------------------- one scene


def run_scene(request: Request, target: str) -> dict[str, Path | None]:
    """Bring `target` and what it needs up to date; stage -> its artifact's folder, None where it is left out.

    Raises Refused before any work, Failed where a stage fails.
    """
    job = prepare(request)
    stages = job.pipeline.closure(target)
    with ExitStack() as held:
        if job.home != job.base:
            held.enter_context(locked(job.runs, job.name, shared=True))
        lock = held.enter_context(locked(job.runs, job.label))
        job.home.mkdir(parents=True, exist_ok=True)
        recover(job.home)
        planned = plan(job, stages)
        say(table(job, planned))
        refuse_missing(job, planned)
        (job.home / "profile").write_text(job.profile + "\n")
        (job.home / "source").write_text(source_of(job.folder, job.root) + "\n")
        done: dict[str, Decision] = {}
        for position, stage in enumerate(stages):
            done[stage] = decide(job, stage, done)
            if done[stage].word == "run":
                done[stage] = run_stage(job, stage, done[stage], done, lock)
                if any(planned[later].word == "undecided" for later in stages[position + 1 :]):
                    planned = plan(job, stages, done)
                    if not any(planned[later].word == "undecided" for later in stages[position + 1 :]):
                        say(table(job, {later: planned[later] for later in stages[position + 1 :]}))
                    refuse_missing(job, planned)
        job.hashes.save()
    return {stage: decision.path for stage, decision in done.items()}


def refuse_missing(job: Job, planned: dict[str, Decision]) -> None:
    for stage, decision in planned.items():
        if decision.word == "missing":
            raise Refused(f"{job.label}: {stage}: {decision.reason}")


def clean(request: Request) -> None:
    """Remove what was computed for a scene with its variants, or for one variant. Works for a scene that is gone."""
    name = Path(request.scene).name
    names = (
        [f"{name}@{request.variant}"]
        if request.variant
        else [name, *sorted(p.name for p in request.runs.glob(f"{name}@*"))]
    )
    with ExitStack() as held:
        for each in names:
            held.enter_context(locked(request.runs, each, wait=False))
        for each in names:
            if (request.runs / each).exists():
                shutil.rmtree(request.runs / each)
                say(f"removed {shown(request.runs / each)}")


# -------------------------------------------------------------------------------------------------------- results


def _mean(evaluate: Path | None, of: str = "mean") -> dict[str, float | None]:
    return json.loads((evaluate / "metrics.json").read_text()).get(of, {}) if evaluate else {}


def show_results(stage: str, folder: Path | None) -> None:
    """Where the results are; after `evaluate` the mean metrics too, those of the initialization beside them."""
    if folder is None:
        return
    if stage == "evaluate":
        initial = _mean(folder, "initialize")
        for name, value in _mean(folder).items():
            before = _number(initial.get(name))
            say(
                f"  {name:<16} {_number(value) or 'not available':<14}"
                + (f" initialization {before}" if before else "")
            )
    names = (p.name + ("/" if p.is_dir() else "") for p in sorted(folder.iterdir()) if p.name != RECEIPT)
    say(f"results in {shown(folder)}/: {', '.join(names)}")


def _number(value: Any) -> str:
    return f"{value:.4f}" if isinstance(value, float) else "" if value is None else str(value)


def batch(request: Request, folder: Path) -> int:
    """Every scene in `folder`, one after another; a table in runs/results.{csv,md}. Returns how many failed."""
    scenes = sorted(p for p in folder.iterdir() if p.is_dir() and p.name[0] not in "._") if folder.is_dir() else []
    if not scenes:
        raise Refused(f"data={folder}: no folders of scenes there")
    rows: dict[str, dict[str, float | None]] = {}
    failed: dict[str, str] = {}
    for scene in scenes:
        try:
            rows[scene.name] = _mean(run_scene(replace(request, scene=str(scene)), "all").get("evaluate"))
        except (Refused, Failed) as error:
            failed[scene.name] = str(error)
            print(f"error: {error}", file=sys.stderr, flush=True)
    suffix = f"@{request.variant}" if request.variant else ""
    _write_table(request.runs / f"results{suffix}", rows, failed)
    for name, reason in failed.items():
        say(f"failed: {name}: {reason}")
    say(f"{len(rows)} of {len(scenes)} scenes done; table: {shown(request.runs)}/results{suffix}.csv and .md")
    return len(failed)


def _write_table(stem: Path, rows: dict[str, dict[str, float | None]], failed: dict[str, str]) -> None:
    """A row a scene, and the mean over the scenes that have a value."""
    names = list(dict.fromkeys(name for row in rows.values() for name in row))
    lines = [[scene, "done", *(_number(row.get(name)) for name in names)] for scene, row in rows.items()]
    lines += [[scene, "failed", *("" for _ in names)] for scene in failed]
    means = []
    for name in names:
        values = [row[name] for row in rows.values() if isinstance(row.get(name), int | float)]
        means.append(_number(sum(values) / len(values)) if values else "")  # type: ignore[arg-type]
    lines.append([f"mean of {len(rows)}", "", *means])
    header = ["scene", "state", *names]
    stem.parent.mkdir(parents=True, exist_ok=True)
    with open(f"{stem}.csv", "w", newline="") as file:
        csv.writer(file).writerows([header, *lines])
    text = [" | ".join(cells) for cells in (header, ["---"] * len(header), *lines)]
    Path(f"{stem}.md").write_text("".join(f"| {line} |\n" for line in text))


def shown(path: Path) -> str:
    """A path as people type it: from the current folder where it lies below."""
    return os.path.relpath(path) if path.is_relative_to(Path.cwd()) else str(path)
