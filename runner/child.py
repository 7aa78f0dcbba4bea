"""The process in which stages are imported: `describe` reads their parameters, `fetch` gets the weights they name,
`run` does a stage's work."""

from __future__ import annotations

import faulthandler
import importlib
import inspect
import json
import os
import resource
import signal
import sys
import threading
import time
import traceback
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from runner.keys import files_below

INTERRUPTED = 130


def describe() -> None:
    """Standard input: {stage: {"params": asked for, "takes": names of needs, "needs": their paths (for a preview),
    "brings": keys of scene.yaml and its folders, "scene": its folder}}; standard output: `_describe` of each.

    Costs the import of pydantic and of the stage modules, which import nothing heavy at their top, and what a stage
    needs to tell which files of the scene it reads.
    """
    question = json.load(sys.stdin)
    answer_to, sys.stdout = sys.stdout, sys.stderr  # whatever a module prints must not mix with the answer
    json.dump({name: _describe(name, **asked) for name, asked in question.items()}, answer_to)


def _describe(
    name: str,
    params: dict[str, Any],
    takes: list[str],
    needs: dict[str, str | None] | None = None,
    brings: list[str] | None = None,
    scene: str | None = None,
) -> dict[str, Any]:
    """All parameters, the names of those that name weights, and where `brings` is given the weights themselves; where
    `scene` is, the files of the scene it "reads" (None: all); or errors in them; or why the stage is "broken"."""
    try:
        stage = importlib.import_module(f"stages.{name}")
        inspect.signature(stage.run).bind(None, None, **dict.fromkeys(takes))
    except Exception as error:
        return {"broken": f"stages/{name}.py: {_one_line(error)}"}
    fields = stage.Params.model_fields
    marked = {field: info.json_schema_extra for field, info in fields.items()}
    answer: dict[str, Any] = {
        "params": {}, "errors": [], "known": list(fields), "notes": [], "refusal": None, "broken": None, "needed": [],
        "reads": None,
        "weights": [field for field, extra in marked.items() if isinstance(extra, dict) and extra.get("weights")],
    }  # fmt: skip
    try:
        resolved = stage.Params(**params)
    except ValidationError as error:
        answer["errors"] = [_error(e) for e in error.errors()]
        return answer
    answer["params"] = resolved.model_dump(mode="json")
    if brings is not None and hasattr(stage, "needed_weights"):
        answer["needed"] = [asdict(need) for need in stage.needed_weights(resolved, frozenset(brings))]
    if scene is not None and hasattr(stage, "scene_files"):
        files = stage.scene_files(resolved, Path(scene), list(files_below(Path(scene))))
        answer["reads"] = sorted(str(path) for path in files)
    if needs is not None and hasattr(stage, "preview"):
        try:
            answer["notes"] = list(stage.preview(resolved, **{n: p and Path(p) for n, p in needs.items()}))
        except ValueError as error:
            answer["refusal"] = _one_line(error)
        except Exception as error:
            answer["notes"] = [f"(its preview failed: {_one_line(error)})"]
    return answer


def fetch() -> int:
    """Get the weights that stages need and that are not here, each once. Standard input: {stage: {"params", "brings"}}.

    Returns how many could not be had; each is told on standard error, and the others are fetched all the same.
    """
    wanted = {}
    for name, asked in json.load(sys.stdin).items():
        stage = importlib.import_module(f"stages.{name}")
        if hasattr(stage, "needed_weights"):
            needs = stage.needed_weights(stage.Params(**asked["params"]), frozenset(asked["brings"]))
            wanted |= {need.name: need for need in needs if need.problem and need.fetched}
    failed = 0
    for need in wanted.values():
        try:
            need.fetch()
            print(f"{need.name}: fetched", flush=True)
        except ValueError as error:
            failed += 1
            print(f"error: {_one_line(error)}", file=sys.stderr, flush=True)
    return failed


def _error(error: Any) -> dict[str, Any]:
    where = [str(part) for part in error["loc"]] or ["?"]
    return {
        "param": where[0],
        "where": ".".join(where),
        "unknown": error["type"] == "extra_forbidden" and len(where) == 1,
        "value": repr(error["input"]),
        "message": error["msg"].removeprefix("Value error, "),
    }


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text if isinstance(error, ValueError) and text else f"{type(error).__name__}: {text}"


def run() -> int:
    """Do one stage. Standard input: one line of JSON, then nothing until the runner is gone.

    The line: {"stage", "params", "out", "needs": {need: path or null}, "log", "result", "lock"}. Writes to `result`
    {"seconds", "peak_memory_mb"} or {"error": one line}, and to `log` the full traceback.
    """
    job = json.loads(sys.stdin.readline())
    os.set_inheritable(job["lock"], False)  # held open until this process ends: no second runner before that
    threading.Thread(target=_end_with_runner, args=(sys.stdin.fileno(),), daemon=True).start()
    began, code = time.perf_counter(), 0
    with open(job["log"], "w") as log:
        faulthandler.enable(log)
        log.write(f"{time.strftime('%F %T')} {job['stage']} {json.dumps(job['params'])}\n")
        try:
            stage = importlib.import_module(f"stages.{job['stage']}")
            needs = {name: path and Path(path) for name, path in job["needs"].items()}
            stage.run(stage.Params(**job["params"]), Path(job["out"]), **needs)
            result = {"seconds": round(time.perf_counter() - began, 2), "peak_memory_mb": _peak_memory_mb()}
        except KeyboardInterrupt:
            return INTERRUPTED
        except Exception as error:
            log.write(traceback.format_exc())
            result, code = {"error": _one_line(error)}, 1
        log.write(f"{time.strftime('%F %T')} {json.dumps(result)}\n")
        faulthandler.disable()
    Path(job["result"]).write_text(json.dumps(result))
    return code


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
    sys.exit({"describe": describe, "fetch": fetch, "run": run}[sys.argv[1]]())
