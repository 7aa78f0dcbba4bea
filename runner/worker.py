"""The process in which stages are imported: `describe` reads their parameters, `fetch` gets the weights they name,
`run` does a stage's work, `frames` takes pictures from a video.

What can be told of a stage before it runs (Params, needed_weights, lacks, unavailable, optional_weights, cost, preview,
scene_files, scene_facts, machine_facts) lies in stages/plan/<stage>.py where there is such a file, which imports
nothing heavy, else in stages/<stage>.py itself.
"""

import ast
import faulthandler
import importlib
import json
import os
import platform
import reprlib
import resource
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TextIO, get_args

from pydantic import BaseModel, ValidationError

from runner.files import files_below, told

INTERRUPTED = 130
THREADS = ("OMP", "MKL", "OPENBLAS", "NUMBA")  # <each>_NUM_THREADS


def _described_in(stage: str) -> Path:
    """The file that describes a stage, as seen from the root, in which this process is started."""
    path = Path(f"stages/plan/{stage}.py")
    return path if path.is_file() else Path(f"stages/{stage}.py")


def _module(path: Path) -> Any:
    return importlib.import_module(".".join(path.with_suffix("").parts))


def describe() -> None:
    """Standard input: a list of {"stage", "params": asked for, "takes": names of needs, "needs": their paths (for a
    preview), "brings": keys of scene.yaml and its folders, "scene": its folder}; standard output: `_describe` of each.
    """
    questions = json.load(sys.stdin)
    answer_to, sys.stdout = sys.stdout, sys.stderr  # whatever a module prints must not mix with the answer
    json.dump([_describe(question) for question in questions], answer_to)


def _describe(asked: dict[str, Any]) -> dict[str, Any]:
    """What `resolve.Described` holds, where `scene` is given with what it reads of it; where `brings` is the weights
    that are "needed", and what this machine "lacks" for CUDA; where `card` is its "cost" on that; where `needs`
    is the preview's "notes" or "refusal"; or {"broken": why}; or {"errors": in the params, "known": names}."""
    stage, needs, brings, scene = (asked.get(name) for name in ("stage", "needs", "brings", "scene"))
    path = _described_in(stage)
    try:
        planned = _module(path)
        path = Path(f"stages/{stage}.py")
        _check_run(path, asked["takes"])
    except Exception as error:
        return {"broken": f"{path}: {told(error)}"}
    fields = dict(_fields(planned.Params))
    try:
        resolved = planned.Params(**asked["params"])
    except ValidationError as error:
        return {"errors": [_error(e, planned.Params) for e in error.errors()], "known": list(fields)}
    marks = {name: extra for name, extra in fields.items() if isinstance(extra, dict)}
    answer: dict[str, Any] = {
        "params": resolved.model_dump(mode="json"),
        "weights": [name for name, extra in marks.items() if extra.get("weights")],
        "unkeyed": [name for name, extra in marks.items() if extra.get("keyed") is False],
    }
    if hasattr(planned, "machine_facts"):
        answer["machine"] = planned.machine_facts(resolved)
    if brings is not None and hasattr(planned, "optional_weights"):
        answer["optional"] = [asdict(need) for need in planned.optional_weights(resolved)]
    if hasattr(planned, "unavailable"):
        answer["unavailable"] = planned.unavailable(resolved)
    if brings is not None and hasattr(planned, "needed_weights"):
        answer["needed"] = [asdict(need) for need in planned.needed_weights(resolved, frozenset(brings))]
    if brings is not None and hasattr(planned, "lacks") and answer["params"].get("device") == "cuda":
        answer["lacks"] = planned.lacks(resolved)
    if "card" in asked and hasattr(planned, "cost"):
        try:
            answer["cost"] = planned.cost(resolved, asked["card"])
        except ValueError as error:
            answer["unknown card"] = told(error)
    if scene is not None and hasattr(planned, "scene_files"):
        files = planned.scene_files(resolved, Path(scene), list(files_below(Path(scene))))
        answer["reads"] = sorted(str(path) for path in files)
    if scene is not None and hasattr(planned, "scene_facts"):
        try:
            answer["facts"] = planned.scene_facts(resolved, Path(scene))
        except ValueError:  # its preview refuses the scene
            answer["facts"] = {}
    if needs is not None and hasattr(planned, "preview"):
        try:
            answer["notes"] = list(planned.preview(resolved, **{n: p and Path(p) for n, p in needs.items()}))
        except ValueError as error:
            answer["refusal"] = told(error)
        except Exception as error:
            answer["notes"] = [f"(its preview failed: {told(error)})"]
    return answer


def _check_run(path: Path, takes: list[str]) -> None:
    """ValueError where `run` is not made for these needs; read from its source, for a stage may import much."""
    named = {n.name: n.args for n in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(n, ast.FunctionDef)}
    run = named["run"]
    plain, needs = [a.arg for a in run.args][2:], [a.arg for a in run.kwonlyargs]
    free = {*plain[len(plain) - len(run.defaults) :], *(n for n, d in zip(needs, run.kw_defaults, strict=True) if d)}
    wrong = {*plain, *needs} - free - {*takes} or (set() if run.kwarg else {*takes} - {*plain, *needs})
    if wrong:
        raise ValueError(f"run() and pipeline.yaml do not agree on its needs: {', '.join(sorted(wrong))}")


def _fields(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and extra of each parameter, those of groups after one another."""
    for name, info in model.model_fields.items():
        yield prefix + name, info.json_schema_extra
        if _is_group(info.annotation):
            yield from _fields(info.annotation, f"{prefix}{name}.")


def _is_group(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _error(error: Any, model: type[BaseModel]) -> dict[str, Any]:
    """`where` it is, dotted; `unknown`: it is a name that no group has, with what is in it where it is a mapping."""
    where, value, group = _place(error["loc"], model), error["input"], model
    for part in where[:-1]:
        group = _is_group(group) and part in group.model_fields and group.model_fields[part].annotation
    unknown = error["type"] == "extra_forbidden" and _is_group(group)
    while unknown and isinstance(value, dict) and value:
        name, value = next(iter(value.items()))
        where.append(str(name))
    message = error["msg"].removeprefix("Value error, ")
    return {"where": ".".join(where) or "?", "unknown": unknown, "value": reprlib.repr(value), "message": message}


def _place(loc: tuple[Any, ...], model: type[BaseModel]) -> list[str]:
    """The way to what is wrong, without the name of the alternative (of `str | list[str]`) that pydantic tried."""
    field = model.model_fields.get(loc[0]) if loc else None
    alternatives = [kind for kind in get_args(field.annotation) if kind is not NoneType] if field else []
    tried = isinstance(field and field.annotation, UnionType) and len(alternatives) > 1
    return [str(part) for part in (loc[:1] + loc[2:] if tried else loc)]


def fetch() -> int:
    """Get the weights that stages need and that are not here, each once; how many could not be had, which are told on
    standard error. Standard input: {stage: {"params", "brings"}}."""
    wanted = {}
    for stage, asked in json.load(sys.stdin).items():
        planned = _module(_described_in(stage))
        if hasattr(planned, "needed_weights"):
            params = planned.Params(**asked["params"])
            needs = planned.needed_weights(params, frozenset(asked["brings"]))
            needs += planned.optional_weights(params) if hasattr(planned, "optional_weights") else []
            wanted |= {need.name: need for need in needs if need.problem and need.fetched}
    failed = 0
    for need in wanted.values():
        try:
            need.fetch()
            print(f"{need.name}: fetched", flush=True)
        except ValueError as error:
            failed += 1
            print(f"error: {told(error)}", file=sys.stderr, flush=True)
    return failed


def frames() -> int:
    """Take a video's frames. Standard input: {"video", "folder", "content": its hash}; standard output: what was taken,
    or what is wrong."""
    asked = json.load(sys.stdin)
    video = importlib.import_module("reffusion.capture.layouts.video")
    try:
        print(video.take(Path(asked["video"]), Path(asked["folder"]), asked["content"]))
    except ValueError as error:
        print(told(error))
        return 1
    return 0


def run() -> int:
    """Do one stage. Standard input: one line of JSON, then nothing until the runner is gone.

    The line: {"stage", "params", "out", "needs": {need: path or null}, "log", "result", "lock" or null}, and see
    `_confine`. Writes to `result`, an open file's number, {"seconds", "peak_memory_mb", "machine"} or {"error": one
    line}, and to `log` the full traceback.
    """
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])  # Ray's processes, and those started by them, block it
    signal.signal(signal.SIGINT, signal.default_int_handler)
    job = json.loads(sys.stdin.readline())
    for number in (job["lock"], job["result"]):  # the lock is held until this process ends: no second runner before
        if number is not None:
            os.set_inheritable(number, False)
    _confine(job.get("cores"), job.get("on"), job.get("cards"))
    threading.Thread(target=_end_with_runner, args=(sys.stdin.fileno(),), daemon=True).start()
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"
    result: dict[str, Any] = {}
    try:
        with open(job["log"], "w") as log:
            faulthandler.enable(log)
            log.write(f"{time.strftime('%F %T')} {job['stage']} {json.dumps(job['params'])}\n")
            result = _done(job, log)
            log.write(f"{time.strftime('%F %T')} {json.dumps(result)}\n")
            faulthandler.disable()
    except KeyboardInterrupt:
        return INTERRUPTED
    except OSError as error:  # of the log
        result = result or {"error": told(error)}
    os.write(job["result"], json.dumps(result).encode())
    return int("error" in result)


def _confine(cores: int | None, on: list[int] | None, cards: str | None) -> None:
    """Let what is imported from now on use so many threads, on these cores, and these cards; None: as it likes."""
    if cores is not None:
        os.environ |= {f"{library}_NUM_THREADS": str(cores) for library in THREADS}
        os.environ["OPENCV_FOR_THREADS_NUM"] = str(cores)
    if on and hasattr(os, "sched_setaffinity"):  # what asks the system for its cores, and reads no variable
        os.sched_setaffinity(0, on)
    if cards is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = cards


def _done(job: dict[str, Any], log: TextIO) -> dict[str, Any]:
    """What there is to tell of a stage, done here and now."""
    began = time.perf_counter()
    try:
        params = _module(_described_in(job["stage"])).Params(**job["params"])
        stage = importlib.import_module(f"stages.{job['stage']}")
        needs = {name: path and Path(path) for name, path in job["needs"].items()}
        stage.run(params, Path(job["out"]), **needs)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # it is done, and that will be told
    except Exception as error:
        log.write(traceback.format_exc())
        return {"error": told(error)[:9999]}  # what a pipe holds
    seconds = round(time.perf_counter() - began, 2)
    return {"seconds": seconds, "peak_memory_mb": _peak_memory_mb(), "machine": platform.node()}


def _end_with_runner(fd: int) -> None:
    """A runner that is killed must not leave a stage working on in a folder that the next runner takes over."""
    while os.read(fd, 4096):
        pass
    os.kill(os.getpid(), signal.SIGKILL)


def _peak_memory_mb() -> int:
    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, kilobytes elsewhere
    largest = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return round(largest * unit / 2**20)


if __name__ == "__main__":
    code = {"describe": describe, "fetch": fetch, "frames": frames, "run": run}[sys.argv[1]]()
    if sys.argv[1] == "run":
        # Large libraries take most of a second to be taken apart, for nothing: what is to be kept lies in files by now.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)
