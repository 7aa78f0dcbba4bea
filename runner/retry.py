"""Work in a shared folder by machines that may be lost: what one works in has a name of its own for each attempt, so
that one which was given up and works on writes to a folder that is gone. Locks are held where the runner is, never by
the machines that work."""

import shutil
import uuid
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from runner.engine import Ended, Task, carry_out


def attempt(task: Task, told: Callable[[], bool] | None = None) -> Ended:
    """Do a task on this machine in a folder that no other attempt writes to, and which is called as the task says again
    when it ends; begins with what an earlier one left. told: see carry_out."""
    out = Path(task.line["out"])
    mine = out.with_name(f"{out.name}.{uuid.uuid4().hex[:8]}")
    take_over(out)
    out.mkdir(parents=True, exist_ok=True)
    out.rename(mine)
    try:
        return carry_out(replace(task, line=task.line | {"out": str(mine)}), told=told)
    finally:
        if mine.exists() and not out.exists():  # else it was given up for lost, and another is at work
            mine.rename(out)


def take_over(folder: Path) -> None:
    """Let `folder` be what the newest attempt at it left, where its runner or its machine was lost. Copied, so that
    what may still be at work there writes to a folder that is gone."""
    attempts = sorted(folder.parent.glob(f"{folder.name}.*"), key=lambda path: path.stat().st_mtime)
    for left in reversed(attempts):
        if not folder.exists():
            copy = folder.with_name(f".copying-{folder.name}")
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(left, copy, ignore=shutil.ignore_patterns("*.writing"))
            copy.rename(folder)
        shutil.rmtree(left, ignore_errors=True)
