"""Start the project's commands in separate processes, and wait for their results."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def start_module(
    module: str,
    *arguments: object,
    cwd: Path = ROOT,
    env: Mapping[str, str] | None = None,
    merge_stderr: bool = False,
    preexec_fn: Callable[[], object] | None = None,
) -> subprocess.Popen[str]:
    """Start `python -m module arguments` in a new process whose output is captured.

    Args:
        env: environment variables, added to those of this process.
        merge_stderr: whether stderr is captured together with stdout.
        preexec_fn: called in the new process before it runs the module.
    """
    command = [sys.executable, "-m", module, *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **(env or {})}
    errors = subprocess.STDOUT if merge_stderr else subprocess.PIPE
    return subprocess.Popen(
        command, cwd=cwd, env=environment, stdout=subprocess.PIPE, stderr=errors, text=True, preexec_fn=preexec_fn
    )


def run_module(
    module: str,
    *arguments: object,
    cwd: Path = ROOT,
    env: Mapping[str, str] | None = None,
    timeout: float | None = None,
    preexec_fn: Callable[[], object] | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run `python -m module arguments` until it ends; raise subprocess.TimeoutExpired after `timeout` seconds."""
    process = start_module(module, *arguments, cwd=cwd, env=env, preexec_fn=preexec_fn)
    output, errors = process.communicate(timeout=timeout)
    return subprocess.CompletedProcess(process.args, process.returncode, output, errors)


def wait_until(condition: Callable[[], object]) -> None:
    """Return once the condition holds; fail after 90 s, for the machine may be busy."""
    for _ in range(1800):
        if condition():
            return
        time.sleep(0.05)
    raise AssertionError("waited 90 s in vain")


def fake_nvidia_smi(folder: Path, output: str) -> dict[str, str]:
    """Return environment variables under which `nvidia-smi` is a script that prints this output."""
    tool = folder / "nvidia-smi"
    tool.write_text(f"#!/bin/sh\necho '{output}'\n")
    tool.chmod(0o755)
    return {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}"}
