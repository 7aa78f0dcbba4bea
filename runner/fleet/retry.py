"""Repeated attempts at a task on a cluster, whose machines may be lost and share the folder of results.

Each attempt works in a folder with a name of its own. So a machine that was taken for lost, but still works, writes to
a folder that is no longer used. Only the runner holds locks; the machines that run stages hold none.
"""

import uuid
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from runner.artifacts import restore_from_attempt
from runner.process import StageResult, Task, run_process


def run_attempt(task: Task, should_stop: Callable[[], bool] | None = None) -> StageResult:
    """Run a task on this machine, from the state that an earlier attempt left.

    The attempt works in a folder that no other attempt writes to. At the end, also after a failure, this folder is
    renamed to the task's own folder, unless another attempt has begun.

    Args:
        task: the work; its own folder is `task.line["out"]`.
        should_stop: see `process.run_process`.
    """
    out = Path(task.line["out"])
    own = out.with_name(f"{out.name}.{uuid.uuid4().hex[:8]}")
    restore_from_attempt(out)
    out.mkdir(parents=True, exist_ok=True)
    out.rename(own)
    try:
        return run_process(replace(task, line=task.line | {"out": str(own)}), should_stop=should_stop)
    finally:
        if own.exists() and not out.exists():  # else this attempt was taken for lost, and another one works
            own.rename(out)
