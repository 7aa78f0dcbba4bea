"""Runs a task again after its machine was lost, in a folder shared by all machines.

Each attempt works in a folder with a name of its own, so that a machine that was given up and still works writes to a
folder that is gone. Only the runner holds locks, never the machines that work."""

import shutil
import uuid
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from runner.engine import StageResult, Task, run_process


def run_attempt(task: Task, should_stop: Callable[[], bool] | None = None) -> StageResult:
    """Run a task on this machine, in a folder that no other attempt writes to, from the state that an earlier one left.

    The folder has the task's own name again at the end. `should_stop`: see `engine.run_process`."""
    out = Path(task.line["out"])
    own = out.with_name(f"{out.name}.{uuid.uuid4().hex[:8]}")
    take_over(out)
    out.mkdir(parents=True, exist_ok=True)
    out.rename(own)
    try:
        return run_process(replace(task, line=task.line | {"out": str(own)}), should_stop=should_stop)
    finally:
        if own.exists() and not out.exists():  # else it was given up, and another attempt works
            own.rename(out)


def take_over(folder: Path) -> None:
    """Make `folder` what the newest attempt left, where its runner or machine was lost.

    It is a copy, as the lost attempt may still write to its own folder, which is removed."""
    attempts = sorted(folder.parent.glob(f"{folder.name}.*"), key=lambda path: path.stat().st_mtime)
    for attempt in reversed(attempts):
        if not folder.exists():
            copy = folder.with_name(f".copying-{folder.name}")
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(attempt, copy, ignore=shutil.ignore_patterns("*.writing"))
            copy.rename(folder)
        shutil.rmtree(attempt, ignore_errors=True)
