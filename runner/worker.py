"""The process that imports stages, started as `python -m runner.worker <command>`.

The command is `describe` (answers questions about stages) or `run` (runs a stage). Input is read from the standard
input.

The description of a stage is a module with the class Params and optional functions (needed_weights, unavailable,
optional_weights, preview, scene_files, scene_facts, machine_facts). It is stages/plan/<stage>.py, which imports nothing
heavy, or else stages/<stage>.py. The module stages/plan/cuda.py says for all stages what this machine lacks for CUDA.
"""

import ast
import faulthandler
import importlib
import json
import os
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
from typing import Any, TextIO, get_args

from pydantic import BaseModel, ValidationError

from runner.files import MACHINE, list_files
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
    json.dump([_describe(question) for question in questions], output, default=asdict)


def _describe(question: dict[str, Any]) -> dict[str, Any]:
    """Answer a question of `describe` with the fields of `resolve.StageInfo` and those for which the question asks."""
    stage = question["stage"]
    path, own = description_file(stage), Path(f"stages/{stage}.py")
    if not own.is_file():
        return {"broken": f"{own}: no such file, and pipeline.yaml names it"}
    try:
        planned = import_file(path)
        path = own
        _check_run(path, question["takes"])
    except Exception as error:
        return {"broken": f"{path}: {format_error(error)}"}  # the stage's code has an error
    fields = dict(_fields(planned.Params))
    try:
        params = planned.Params(**question["params"])
    except ValidationError as error:
        # Of alternatives, such as a name or keys, the one that was not meant comes last.
        errors = sorted(error.errors(), key=lambda e: e["type"] == "string_type" and isinstance(e["input"], dict))
        return {"errors": [_error(e, planned.Params, list(fields)) for e in errors], "known": list(fields)}
    ask = lambda function, *arguments: getattr(planned, function, lambda *_: None)(*arguments)
    marked = lambda mark, value: [name for name, marks in fields.items() if (marks or {}).get(mark) is value]
    answer = {"params": params.model_dump(mode="json"), "weights": marked("weights", True)}
    answer |= {"unkeyed": marked("keyed", False), "programs": marked("program", True)}
    answer |= {"machine": ask("machine_facts", params), "unavailable": ask("unavailable", params)}
    if "brings" in question:
        answer["needed"] = ask("needed_weights", params, frozenset(question["brings"]))
        answer["optional"] = ask("optional_weights", params)
        if getattr(params, "device", "cpu") == "cuda" and CUDA_FILE.is_file():
            answer["lacks"] = import_file(CUDA_FILE).find_missing(stage, params)
    if "scene" in question:
        scene = Path(question["scene"])
        reads = ask("scene_files", params, scene, list(list_files(scene)))
        answer["reads"] = reads and sorted(map(str, reads))
        with suppress(ValueError):  # the stage's preview reports this error
            answer["facts"] = ask("scene_facts", params, scene)
    if "needs" in question and hasattr(planned, "preview"):
        needs = {name: path and Path(path) for name, path in question["needs"].items()}
        try:
            answer["notes"] = list(planned.preview(params, **needs))
        except ValueError as error:
            answer["refusal"] = format_error(error)
        except Exception as error:
            answer["notes"] = [f"(its preview failed: {format_error(error)})"]
    return {name: value for name, value in answer.items() if value is not None}


def _check_run(path: Path, takes: list[str]) -> None:
    """Check that a stage's run() has its needs in pipeline.yaml (`takes`) as arguments; raises ValueError if not."""
    # The source is parsed and not imported, because stages may import heavy modules.
    named = {n.name: n.args for n in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(n, ast.FunctionDef)}
    run = named["run"]
    defaults = {each.arg: default for each, default in zip(run.kwonlyargs, run.kw_defaults, strict=True)}
    required = {need for need, default in defaults.items() if default is None}
    if wrong := required - {*takes} or (set() if run.kwarg else {*takes} - {*defaults}):
        raise ValueError(f"run() and pipeline.yaml do not agree on its needs: {', '.join(sorted(wrong))}")


def _fields(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the json_schema_extra of each parameter of a model, and of those in its groups."""
    for name, info in model.model_fields.items():
        yield prefix + name, info.json_schema_extra
        if isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel):  # a group of parameters
            yield from _fields(info.annotation, f"{prefix}{name}.")


# Type of an error of pydantic -> words that its own message lacks.
PLAIN_WORDS = {"list_type": "write a list, such as [a, b]", "extra_forbidden": "there is no such key"}


def _error(error: Any, model: type[BaseModel], known: list[str]) -> dict[str, Any]:
    """Convert an entry of pydantic's `ValidationError.errors()`; "unknown" means that no parameter has this name."""
    first, *names = error["loc"] or ("?",)
    kind = model.model_fields[first].annotation if first in model.model_fields else None
    # Of a parameter with alternative types, such as `str | list[str]`, the location also names the type that was tried.
    if isinstance(kind, UnionType) and len({*get_args(kind)} - {NoneType}) > 1:
        names = names[1:]
    where = ".".join(map(str, (first, *names)))
    group, _, _ = where.rpartition(".")
    unknown = error["type"] == "extra_forbidden" and (not group or any(n.startswith(f"{group}.") for n in known))
    value = error["input"]
    while unknown and isinstance(value, dict) and value:  # of an unknown group, its first parameter is named
        name, value = next(iter(value.items()))
        where += f".{name}"
    message = PLAIN_WORDS.get(error["type"]) or error["msg"].removeprefix("Value error, ")
    return {"where": where, "unknown": unknown, "value": reprlib.repr(value), "message": message}


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
    if on:  # some libraries read no variable, but ask the system for its cores
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
    return {"seconds": seconds, "peak_memory_mb": _peak_memory_mb(), "machine": MACHINE}


def _end_with_runner(fd: int) -> None:
    """Wait until the runner has ended, which closes the pipe `fd`, and then kill this process."""
    while os.read(fd, 4096):
        pass
    # Otherwise this process would go on writing to its folder, while the next runner works there.
    os.kill(os.getpid(), signal.SIGKILL)


def _peak_memory_mb() -> int:
    """Return the peak memory of this process, or of its largest child process if that is more, in MB."""
    kilobytes = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return round(max(kilobytes) / 1024)


if __name__ == "__main__":
    if sys.argv[1] == "describe":
        describe()
    else:
        code = run()
        # All results are in files: skip the teardown of large libraries, which takes most of a second.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
