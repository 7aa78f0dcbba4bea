"""The process that imports stages, started as `python -m runner.worker <command>`.

The command is `describe` (answers questions about stages), `frames` (extracts the frames of a video) or `run` (runs a
stage). Input is read from the standard input.

The description of a stage is a module with the class Params and optional functions (needed_weights, unavailable,
optional_weights, preview, scene_files, scene_facts, machine_facts). It is stages/plan/<stage>.py, which imports nothing
heavy, or else stages/<stage>.py. The module stages/plan/cuda.py says for all stages what this machine lacks for CUDA.
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
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TextIO, TypeGuard, get_args

from pydantic import BaseModel, ValidationError

from runner.files import list_files
from runner.text import format_error

INTERRUPTED = 130  # exit code after Ctrl-C
CUDA_FILE = Path("stages/plan/cuda.py")  # relative to the root
THREADS = ("OMP", "MKL", "NUMBA")  # <name>_NUM_THREADS is the number of threads of a library


def description_file(stage: str) -> Path:
    """Return the file that describes a stage, relative to the root, which is the working directory."""
    path = Path(f"stages/plan/{stage}.py")
    return path if path.is_file() else Path(f"stages/{stage}.py")


def import_file(path: Path) -> Any:
    """Import a Python file, whose path is relative to the root, as a module."""
    return importlib.import_module(".".join(path.with_suffix("").parts))


def describe() -> None:
    """Answer questions about stages. Reads a JSON list of questions and prints the JSON list of their answers.

    A question has the following fields. Only the first three are mandatory; each other one asks for more, see
    `_describe`:

    - "stage": name of the stage;
    - "params": the parameters as they were asked for;
    - "takes": names of its needs in pipeline.yaml;
    - "scene": folder of the scene;
    - "brings": keys of scene.yaml and names of the scene's folders;
    - "needs": need -> path, or null.
    """
    questions = json.load(sys.stdin)
    output, sys.stdout = sys.stdout, sys.stderr  # modules may print, which must not mix with the answer
    json.dump([_describe(question) for question in questions], output)


def _describe(question: dict[str, Any]) -> dict[str, Any]:
    """Answer a question of `describe` with the fields of `resolve.StageInfo` and those for which the question asks."""
    stage = question["stage"]
    path = description_file(stage)
    try:
        planned = import_file(path)
        path = Path(f"stages/{stage}.py")
        _check_run(path, question["takes"])
    except Exception as error:
        return {"broken": f"{path}: {format_error(error)}"}  # the stage's code has an error
    fields = dict(_fields(planned.Params))
    try:
        params = planned.Params(**question["params"])
    except ValidationError as error:
        return {"errors": [_error(e, planned.Params) for e in error.errors()], "known": list(fields)}
    marked = lambda mark, value: [name for name, marks in fields.items() if (marks or {}).get(mark) is value]
    answer = {"params": params.model_dump(mode="json"), "weights": marked("weights", True)}
    answer |= {"unkeyed": marked("keyed", False), "programs": marked("program", True)}
    if hasattr(planned, "machine_facts"):
        answer["machine"] = planned.machine_facts(params)
    if hasattr(planned, "unavailable"):
        answer["unavailable"] = planned.unavailable(params)
    if "brings" in question:
        answer |= _describe_lacks(planned, params, stage, frozenset(question["brings"]))
    if "scene" in question:
        answer |= _describe_scene(planned, params, Path(question["scene"]))
    if "needs" in question and hasattr(planned, "preview"):
        needs = {name: path and Path(path) for name, path in question["needs"].items()}
        try:
            answer["notes"] = list(planned.preview(params, **needs))
        except ValueError as error:
            answer["refusal"] = format_error(error)
        except Exception as error:
            answer["notes"] = [f"(its preview failed: {format_error(error)})"]
    return answer


def _describe_lacks(planned: Any, params: Any, stage: str, brings: frozenset[str]) -> dict[str, Any]:
    """Return the weights that a stage needs and could use, and what this machine lacks for CUDA."""
    answer = {}
    if hasattr(planned, "needed_weights"):
        answer["needed"] = [asdict(need) for need in planned.needed_weights(params, brings)]
    if hasattr(planned, "optional_weights"):
        answer["optional"] = [asdict(need) for need in planned.optional_weights(params)]
    if getattr(params, "device", "cpu") == "cuda" and CUDA_FILE.is_file():
        answer["lacks"] = import_file(CUDA_FILE).find_missing(stage, params)
    return answer


def _describe_scene(planned: Any, params: Any, scene: Path) -> dict[str, Any]:
    """Return which files of the scene a stage reads, and which facts about it the stage depends on."""
    answer: dict[str, Any] = {}
    if hasattr(planned, "scene_files"):
        answer["reads"] = sorted(map(str, planned.scene_files(params, scene, list(list_files(scene)))))
    if hasattr(planned, "scene_facts"):
        with suppress(ValueError):  # the stage's preview reports this error
            answer["facts"] = planned.scene_facts(params, scene)
    return answer


def _check_run(path: Path, takes: list[str]) -> None:
    """Check that a stage's run() has its needs in pipeline.yaml (`takes`) as arguments; raises ValueError if not."""
    # The source is parsed and not imported, because stages may import heavy modules.
    named = {n.name: n.args for n in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(n, ast.FunctionDef)}
    run = named["run"]
    plain, needs = [a.arg for a in run.args][2:], [a.arg for a in run.kwonlyargs]
    free = {*plain[len(plain) - len(run.defaults) :], *(n for n, d in zip(needs, run.kw_defaults, strict=True) if d)}
    wrong = {*plain, *needs} - free - {*takes} or (set() if run.kwarg else {*takes} - {*plain, *needs})
    if wrong:
        raise ValueError(f"run() and pipeline.yaml do not agree on its needs: {', '.join(sorted(wrong))}")


def _fields(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the json_schema_extra of each parameter of a model, and of those in its groups."""
    for name, info in model.model_fields.items():
        yield prefix + name, info.json_schema_extra
        if _is_group(info.annotation):
            yield from _fields(info.annotation, f"{prefix}{name}.")


def _is_group(annotation: Any) -> TypeGuard[type[BaseModel]]:
    """Return whether a parameter with this annotation is a group of parameters."""
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _error(error: Any, model: type[BaseModel]) -> dict[str, Any]:
    """Convert an entry of pydantic's `ValidationError.errors()`; "unknown" means that no parameter has this name."""
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
    """Return the names that lead to a wrong value in a model, from the location that pydantic gives."""
    field = model.model_fields.get(loc[0]) if loc else None
    alternatives = [kind for kind in get_args(field.annotation) if kind is not NoneType] if field else []
    # Of a parameter with alternative types, such as `str | list[str]`, the location also names the type that was tried.
    tried = isinstance(field and field.annotation, UnionType) and len(alternatives) > 1
    return [str(part) for part in (loc[:1] + loc[2:] if tried else loc)]


def frames() -> int:
    """Extract the frames of a video. Prints a sentence about the result or the error, and returns the exit code.

    Reads a JSON object: {"video": path, "folder": path of the folder to fill, "content": hash of the video}.
    """
    question = json.load(sys.stdin)
    video = importlib.import_module("reffusion.capture.video_frames")
    try:
        print(video.extract_frames(Path(question["video"]), Path(question["folder"]), question["content"]))
    except ValueError as error:
        print(format_error(error))
        return 1
    return 0


def run() -> int:
    """Run a stage, and return the exit code.

    Reads one line of JSON from the standard input. The runner keeps the input open; when it closes, the runner has
    ended, and this process ends too. The line has:

    - "stage", "params": name and parameters of the stage;
    - "out": the folder in which the stage writes;
    - "needs": need -> path, or null for a skipped one;
    - "log": path of the log file, which also gets tracebacks;
    - "result": file descriptor for the answer;
    - "lock": file descriptor of a lock, which stays open until this process ends, or null;
    - optionally the arguments of `_limit_resources`.

    The answer is {"seconds", "peak_memory_mb", "machine"}, or {"error": one line}. The seconds are wall-clock time of
    this process, from the import of the stage, and not of earlier attempts that it resumes.
    """
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])  # Ray blocks this signal in its processes
    signal.signal(signal.SIGINT, signal.default_int_handler)
    job = json.loads(sys.stdin.readline())
    for number in (job["lock"], job["result"]):  # children must not inherit them, or they would hold the lock longer
        if number is not None:
            os.set_inheritable(number, False)
    _limit_resources(job.get("cores"), job.get("on"), job.get("gpus"))
    threading.Thread(target=_end_with_runner, args=(sys.stdin.fileno(),), daemon=True).start()
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"
    result: dict[str, Any] = {}
    try:
        with open(job["log"], "w") as log:
            faulthandler.enable(log)
            log.write(f"{time.strftime('%F %T')} {job['stage']} {json.dumps(job['params'])}\n")
            result = _run_stage(job, log)
            log.write(f"{time.strftime('%F %T')} {json.dumps(result)}\n")
            faulthandler.disable()
    except KeyboardInterrupt:
        return INTERRUPTED
    except OSError as error:  # the log file could not be written
        result = result or {"error": format_error(error)}
    os.write(job["result"], json.dumps(result).encode())
    return int("error" in result)


def _limit_resources(cores: int | None, on: list[int] | None, gpus: str | None) -> None:
    """Limit the threads, the CPU cores `on` and the GPUs ("0,1") of libraries imported later; None means no limit."""
    if cores is not None:
        os.environ |= {f"{library}_NUM_THREADS": str(cores) for library in THREADS}
        os.environ["OPENCV_FOR_THREADS_NUM"] = str(cores)
    if on and hasattr(os, "sched_setaffinity"):  # some libraries read no variable, but ask the system for its cores
        os.sched_setaffinity(0, on)
    if gpus is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus


def _run_stage(job: dict[str, Any], log: TextIO) -> dict[str, Any]:
    """Run a stage in this process and return its answer, see `run`; the traceback of an error is written to `log`."""
    started = time.perf_counter()
    try:
        params = import_file(description_file(job["stage"])).Params(**job["params"])
        stage = importlib.import_module(f"stages.{job['stage']}")
        needs = {name: path and Path(path) for name, path in job["needs"].items()}
        stage.run(params, Path(job["out"]), **needs)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the stage is done, and Ctrl-C must not lose its result
    except Exception as error:
        log.write(traceback.format_exc())
        return {"error": format_error(error)[:9999]}  # short enough for the buffer of a pipe
    seconds = round(time.perf_counter() - started, 2)
    return {"seconds": seconds, "peak_memory_mb": _peak_memory_mb(), "machine": platform.node()}


def _end_with_runner(fd: int) -> None:
    """Wait until the runner has ended, which closes the pipe `fd`, and then kill this process."""
    while os.read(fd, 4096):
        pass
    # Otherwise this process would go on writing to its folder, while the next runner works there.
    os.kill(os.getpid(), signal.SIGKILL)


def _peak_memory_mb() -> int:
    """Return the peak memory of this process, or of its largest child process if that is more, in MB."""
    unit = 1 if sys.platform == "darwin" else 1024  # ru_maxrss is in bytes there, in kB elsewhere
    largest = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return round(largest * unit / 2**20)


if __name__ == "__main__":
    code = {"describe": describe, "frames": frames, "run": run}[sys.argv[1]]()
    if sys.argv[1] == "run":
        # All results are in files: skip the teardown of large libraries, which takes most of a second.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code or 0)
    sys.exit(code)
