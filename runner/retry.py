"""Repeated attempts at a task on a cluster, whose machines may be lost and share the folder of results.

Each attempt works in a folder with a name of its own. So a machine that was taken for lost, but still works, writes to
a folder that is no longer used. Only the runner holds locks; the machines that run stages hold none.
"""

import shutil
import uuid
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from runner.engine import StageResult, Task, run_process


def run_attempt(task: Task, should_stop: Callable[[], bool] | None = None) -> StageResult:
    """Run a task on this machine, from the state that an earlier attempt left.

    The attempt works in a folder that no other attempt writes to. At the end, also after a failure, this folder is
    renamed to the task's own folder, unless another attempt has begun.

    Args:
        task: the work; its own folder is `task.line["out"]`.
        should_stop: see `engine.run_process`.
    """
    out = Path(task.line["out"])
    own = out.with_name(f"{out.name}.{uuid.uuid4().hex[:8]}")
    take_over(out)
    out.mkdir(parents=True, exist_ok=True)
    out.rename(own)
    try:
        return run_process(replace(task, line=task.line | {"out": str(own)}), should_stop=should_stop)
    finally:
        if own.exists() and not out.exists():  # else this attempt was taken for lost, and another one works
            own.rename(out)


def take_over(folder: Path) -> None:
    """Restore `folder` from the newest attempt whose runner or machine was lost, if `folder` does not exist.

    The attempt's folder, <folder>.<suffix>, is copied and not renamed, because the lost attempt may still write to it.
    The folders of all attempts are removed, even if `folder` exists.
    """
    attempts = sorted(folder.parent.glob(f"{folder.name}.*"), key=lambda path: path.stat().st_mtime)
    for attempt in reversed(attempts):
        if not folder.exists():
            copy = folder.with_name(f".copying-{folder.name}")
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(attempt, copy, ignore=shutil.ignore_patterns("*.writing"))
            copy.rename(folder)
        shutil.rmtree(attempt, ignore_errors=True)
