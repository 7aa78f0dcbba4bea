"""The processes of stages (worker.py): starts them, asks them questions about stages, and runs stages in them."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from runner import Refused

PROJECT = Path(__file__).resolve().parent.parent  # the folder with runner/ and report/
GRACE = 20.0  # seconds after which an interrupted stage that has not ended is killed


@dataclass(frozen=True)
class Resources:
    """The resources of one stage.

    Attributes:
        cores: number of CPU cores. None for all cores of this machine, or for one core on a cluster.
        gpus: number of GPUs.
        memory_mb: CPU memory to reserve, MB.
    """

    cores: int | None
    gpus: int
    memory_mb: int


@dataclass(frozen=True)
class Task:
    """The work of one stage.

    Attributes:
        root: folder with pipeline.yaml and stages/.
        line: the job description that `worker.run` reads; paths are text. `run_process` adds "result" and "lock", and
            an engine adds the cores and GPUs.
        output: the file to which everything that the stage prints is appended; None for the runner's own output.
    """

    root: Path
    line: dict[str, Any]
    output: Path | None = None


@dataclass(frozen=True)
class StageResult:
    """The result of a stage's process.

    Attributes:
        answer: the answer of the process, see `worker.run`; empty if it gave none.
        code: exit code; the negative number of a signal that ended the process.
        interrupted: True if the runner was interrupted (Ctrl-C) while it waited for the process.
    """

    answer: dict[str, Any]
    code: int
    interrupted: bool = False


class Engine(Protocol):
    """A place where stages run: this machine, or one of those in runner/fleet/."""

    def run(self, task: Task, resources: Resources, lock: int, on_start: Callable[[], None]) -> StageResult:
        """Wait for the resources, run a task in a process, and wait for its end.

        A failure of the stage is no exception; it is in the result. A process that is lost may be started again.

        Args:
            task: the work.
            resources: the resources that the process gets.
            lock: open file descriptor of the lock of the scene's folder in runs/. A local process keeps it open, so
                that the lock is held until the process ends.
            on_start: called when the task has its resources, or on a cluster when it is submitted. If the task is
                started again, it may be called again.

        Raises:
            KeyboardInterrupt: the engine was stopped before the task succeeded.
        """
        ...


class ThisMachine:
    """The engine that runs one stage at a time on this machine."""

    def run(self, task: Task, resources: Resources, lock: int, on_start: Callable[[], None]) -> StageResult:
        """See `Engine.run`."""
        on_start()
        on = sorted(os.sched_getaffinity(0))[: resources.cores]
        where = {"cores": len(on), "on": on} if resources.cores else {}
        result = run_process(replace(task, line=task.line | where), lock)
        if result.interrupted and result.code != 0:
            raise KeyboardInterrupt
        return result


def start_worker(root: Path, *arguments: str, module: str = "runner.worker", **options: Any) -> subprocess.Popen[str]:
    """Start the process `python -m <module> <arguments>`, with a pipe for text as its standard input.

    Args:
        root: folder with pipeline.yaml and stages/; it is the working directory and comes first on the import path.
        arguments: the command of the worker, such as "run".
        module: the module to start.
        options: further arguments of subprocess.Popen.
    """
    path = os.pathsep.join(filter(None, [str(root), str(PROJECT), os.environ.get("PYTHONPATH", "")]))
    command, environment = [sys.executable, "-m", module, *arguments], {**os.environ, "PYTHONPATH": path}
    return subprocess.Popen(command, cwd=root, env=environment, stdin=subprocess.PIPE, text=True, **options)


def ask_stages(root: Path, questions: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Send questions about stages to one worker process, and return its answers in the same order.

    Args:
        root: folder with pipeline.yaml and stages/.
        questions: see `worker.describe`.

    Raises:
        Refused: the process failed.
    """
    if not questions:
        return []
    process = start_worker(root, "describe", stdout=subprocess.PIPE)
    answers, _ = process.communicate(json.dumps(questions))
    if process.returncode:
        raise Refused("the stages could not be asked for their parameters (see above)")
    return json.loads(answers)


def run_process(task: Task, lock: int | None = None, should_stop: Callable[[], bool] | None = None) -> StageResult:
    """Run a task in a new process on this machine, and wait for its end.

    An interrupt (Ctrl-C) is passed on to the process, which is killed if it has not ended after GRACE seconds. No
    KeyboardInterrupt is raised, because the stage may have finished; see `StageResult.interrupted`.

    Args:
        task: the work.
        lock: file descriptor of a lock that the process keeps open, too; None for no lock.
        should_stop: called every second; if it returns True, the process is interrupted as by Ctrl-C. None: never.
    """
    reader, writer = os.pipe()  # a pipe and not a file, because the answer may be that the disk is full
    answer: dict[str, Any] = {}
    interrupted = False
    with open(task.output, "a") if task.output else nullcontext() as output:
        # The process has a process group of its own, so that Ctrl-C reaches it only once, passed on from here.
        descriptors = (writer,) if lock is None else (lock, writer)
        process = start_worker(task.root, "run", pass_fds=descriptors, process_group=0, stdout=output, stderr=output)
    assert process.stdin
    os.close(writer)
    try:
        with suppress(BrokenPipeError):  # the worker may have ended already; its exit code is read below
            process.stdin.write(json.dumps(task.line | {"result": writer, "lock": lock}) + "\n")
            process.stdin.flush()  # the pipe stays open: when this process ends, it closes and the worker ends too
        code = _wait(process, should_stop)
    except KeyboardInterrupt:
        code, interrupted = _interrupt(process), True
    finally:
        with suppress(BrokenPipeError):
            process.stdin.close()
        os.set_blocking(reader, False)  # else reading could wait for processes that the stage started
        with suppress(BlockingIOError), open(reader, "rb", buffering=0) as file:
            answer = json.loads(file.read(1 << 16) or "{}")
    return StageResult(answer, code, interrupted)


def _wait(process: "subprocess.Popen[str]", should_stop: Callable[[], bool] | None) -> int:
    """Wait for a process, interrupt it as soon as `should_stop` returns True, and return its exit code."""
    while not (should_stop and should_stop()):
        with suppress(subprocess.TimeoutExpired):
            return process.wait(1.0 if should_stop else None)
    return _interrupt(process)


def _interrupt(process: "subprocess.Popen[str]") -> int:
    """Interrupt a process, kill it if it has not ended after GRACE seconds, and return its exit code."""
    process.send_signal(signal.SIGINT)
    try:
        return process.wait(GRACE)
    except (subprocess.TimeoutExpired, KeyboardInterrupt):
        process.kill()
        return process.wait()
