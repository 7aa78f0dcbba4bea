"""Engines run the processes of stages with given cores, memory and GPUs: here on this machine, in ray_engine.py and
slurm_engine.py on clusters."""

import importlib
import json
import os
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from runner import Refused, say
from runner.process import start_worker

ALL_MEMORY_MB = 2**40  # more than any machine has: the stage runs alone
GRACE = 20.0  # seconds that an interrupted stage has to end by itself
CGROUPS = (("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
           ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"))  # fmt: skip


@dataclass(frozen=True)
class Resources:
    """What a stage gets: cores (None: all), GPUs, CPU memory in MB."""

    cores: int | None
    gpus: int
    memory_mb: int


@dataclass(frozen=True)
class Task:
    """The work of one stage.

    Attributes:
        root: the folder with pipeline.yaml and stages/.
        line: what `worker.run` reads, without what `run_process` adds; paths are text.
        output: the file to which the stage appends what it prints; None: the runner's own output.
    """

    root: Path
    line: dict[str, Any]
    output: Path | None = None


@dataclass(frozen=True)
class StageResult:
    """How a stage's process ended.

    Attributes:
        answer: see `worker.run`; empty where the process gave none.
        code: exit code; negative for a signal.
        interrupted: the wait for it was interrupted.
    """

    answer: dict[str, Any]
    code: int
    interrupted: bool = False


class Engine(Protocol):
    """Where stages run.

    Attributes:
        cuda: whether it has a GPU; None: see `resolve.has_cuda`.
        cores: in all.
        is_remote: whether other machines work in the folder of results.
    """

    cuda: bool | None
    cores: int
    is_remote: bool

    def run(self, task: Task, resources: Resources, lock: int, on_start: Callable[[], None]) -> StageResult:
        """Run a task; calls `on_start` when it has its resources. The process holds the file descriptor `lock` open.

        Raises:
            KeyboardInterrupt: the engine was stopped.
        """
        ...

    def stop(self) -> None:
        """Interrupt what runs, and start nothing more. May be called from another thread."""
        ...


class LocalEngine:
    """Runs stages on this machine. Any number of threads may call `run`; each waits for its resources."""

    cuda: bool | None = None
    is_remote = False

    def __init__(self, cores: list[int] | None = None, memory_mb: int | None = None, gpus: list[str] | None = None):
        """Numbers of the cores, memory, and numbers of the GPUs to use; by default all that this process may use."""
        self._cores = sorted(os.sched_getaffinity(0)) if cores is None else list(cores)
        self._gpus = visible_gpus() if gpus is None else list(gpus)
        self.cores, self._gpu_count = len(self._cores), len(self._gpus)
        self.memory_mb = memory_mb if memory_mb is not None else free_memory_mb()
        self._asks_system = memory_mb is None
        self._reserved: dict[int, int] = {}  # running task -> its memory, MB
        self._running: set[subprocess.Popen[str]] = set()
        self._change, self._stopped, self._number = threading.Condition(), False, 0

    def run(self, task: Task, resources: Resources, lock: int, on_start: Callable[[], None]) -> StageResult:
        """See `Engine.run`."""
        result, others = self._run_once(task, resources, lock, on_start)
        if result.code == -signal.SIGKILL and others:  # probably out of memory: it resumes alone
            result, _ = self._run_once(task, replace(resources, memory_mb=ALL_MEMORY_MB), lock, on_start)
        return result

    def _run_once(
        self, task: Task, resources: Resources, lock: int, on_start: Callable[[], None]
    ) -> tuple[StageResult, int]:
        """The result, and how many other stages ran at its end."""
        with self._reserve(resources) as (cores, gpus):
            on_start()
            where = {"cores": len(cores), "on": cores} if resources.cores is not None else {}
            where |= {"gpus": ",".join(gpus)} if gpus and self._gpu_count > 1 else {}
            result = run_process(replace(task, line=task.line | where), lock, self._follow)
            others = len(self._reserved) - 1
        if result.interrupted:
            self._stopped = True  # a finished artifact is still moved into place; nothing starts after it
        if self._stopped and result.code != 0:
            raise KeyboardInterrupt
        return result, others

    def stop(self) -> None:
        """See `Engine.stop`."""
        with self._change:
            self._stopped = True
            self._change.notify_all()
            for process in self._running:
                process.send_signal(signal.SIGINT)
                threading.Timer(GRACE, process.kill).start()

    @contextmanager
    def _follow(self, process: "subprocess.Popen[str]") -> Iterator[None]:
        with self._change:
            self._running.add(process)
            if self._stopped:
                process.send_signal(signal.SIGINT)
        try:
            yield
        finally:
            with self._change:
                self._running.discard(process)

    @contextmanager
    def _reserve(self, resources: Resources) -> Iterator[tuple[list[int], list[str]]]:
        """Wait for a stage's cores, GPUs and memory, and hold them. A stage that asks for more memory than there is
        runs alone."""
        core_count = min(resources.cores or self.cores, self.cores)
        gpu_count = min(resources.gpus, self._gpu_count)
        with self._change:
            self._number += 1
            number = self._number
            while not (self._stopped or self._fits(core_count, gpu_count, resources.memory_mb)):
                self._change.wait(1.0)  # free memory changes without a notification
            if self._stopped:
                raise KeyboardInterrupt
            cores, self._cores = self._cores[:core_count], self._cores[core_count:]
            gpus, self._gpus = self._gpus[:gpu_count], self._gpus[gpu_count:]
            self._reserved[number] = resources.memory_mb
        try:
            yield cores, gpus
        finally:
            with self._change:
                self._cores, self._gpus = sorted(self._cores + cores), sorted(self._gpus + gpus)
                del self._reserved[number]
                self._change.notify_all()

    def _fits(self, cores: int, gpus: int, memory_mb: int) -> bool:
        if not self._reserved:
            return True
        reserved = sum(self._reserved.values()) + memory_mb
        enough = reserved <= self.memory_mb and (not self._asks_system or memory_mb <= free_memory_mb())
        return cores <= len(self._cores) and gpus <= len(self._gpus) and enough


def free_memory_mb() -> int:
    """Free memory of this machine, or of the control group of this process if that is less."""
    found = []
    with suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text().splitlines()
        found.append(int(next(line for line in lines if line.startswith("MemAvailable:")).split()[1]) * 1024)
    for limit, used in CGROUPS:
        with suppress(OSError, ValueError):  # "max": no limit
            found.append(int(Path(limit).read_text()) - int(Path(used).read_text()))
    return min(found, default=2**50) // 2**20


def visible_gpus() -> list[str]:
    """Numbers of the GPUs that this process may use."""
    listed = os.environ.get("CUDA_VISIBLE_DEVICES")
    if listed is not None:
        return [number for number in listed.split(",") if number not in ("", "-1")]
    return sorted((path.name.removeprefix("nvidia") for path in Path("/dev").glob("nvidia[0-9]*")), key=int)


def run_process(
    task: Task,
    lock: int | None = None,
    follow: Callable[[Any], Any] = nullcontext,
    should_stop: Callable[[], bool] | None = None,
) -> StageResult:
    """Run a task in a fresh process on this machine, and wait for its end.

    Passes an interrupt on to the process and does not raise it, as the stage may have finished.

    Args:
        lock: an open file that the process holds, too.
        follow: a context that gets the process, entered while it runs.
        should_stop: called every second; where it returns True the process is interrupted.
    """
    reader, writer = os.pipe()  # not a file: the answer may be that the disk is full
    line = json.dumps(task.line | {"result": writer, "lock": lock})
    answer: dict[str, Any] = {}
    interrupted = False
    with open(task.output, "a") if task.output else nullcontext() as output:
        # A process group of its own: Ctrl-C reaches it once, from here.
        descriptors = (writer,) if lock is None else (lock, writer)
        process = start_worker(task.root, "run", pass_fds=descriptors, process_group=0, stdout=output, stderr=output)
    assert process.stdin
    os.close(writer)
    try:
        with follow(process):
            with suppress(BrokenPipeError):  # a worker that is gone already has its code below
                process.stdin.write(line + "\n")
                process.stdin.flush()  # and stays open: the worker ends when this process does
            code = _poll(process, should_stop) if should_stop else process.wait()
    except KeyboardInterrupt:
        code, interrupted = _interrupt(process), True
    finally:
        with suppress(BrokenPipeError):
            process.stdin.close()
        os.set_blocking(reader, False)  # processes that the stage started may still hold the other end
        with suppress(BlockingIOError), open(reader, "rb", buffering=0) as file:
            answer = json.loads(file.read(1 << 16) or "{}")
    return StageResult(answer, code, interrupted)


def _poll(process: "subprocess.Popen[str]", should_stop: Callable[[], bool]) -> int:
    """Wait for a process, or interrupt it; its exit code."""
    while not should_stop():
        with suppress(subprocess.TimeoutExpired):
            return process.wait(1.0)
    return _interrupt(process)


def _interrupt(process: "subprocess.Popen[str]") -> int:
    """Interrupt a process, and kill it after GRACE seconds; its exit code."""
    process.send_signal(signal.SIGINT)
    try:
        return process.wait(GRACE)
    except (subprocess.TimeoutExpired, KeyboardInterrupt):
        process.kill()
        return process.wait()


# name -> class in <name>_engine.py, the package that it imports
ENGINES = {"ray": ("RayEngine", "ray"), "slurm": ("SlurmEngine", "submitit")}


def make_engine(name: str | None, address: str | None, root: Path, runs: Path) -> Engine:
    """The engine of this name, of this machine by default. Raises Refused where it is unknown or unreachable."""
    if name in (None, "", "local"):
        if address:
            raise Refused(f"address={address}: of which engine? For example engine=ray address={address}")
        return LocalEngine()
    if name not in ENGINES:
        raise Refused(f"engine={name}: unknown; known: local, {', '.join(ENGINES)}")
    kind, library = ENGINES[name]
    try:
        module = importlib.import_module(f"runner.{name}_engine")
    except ImportError as error:
        if error.name != library:
            raise
        raise Refused(f"engine={name}: {library} is not installed; `pip install 'reffusion[cluster]'`") from None
    engine: Engine = getattr(module, kind)(address, root, runs)
    say(f"engine {name}: {engine.cores} cores")
    return engine
