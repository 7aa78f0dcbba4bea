"""Engines, which run the processes of stages with given cores, memory and GPUs.

The engine of this module uses this machine; those of ray_engine.py and slurm_engine.py use clusters.
"""

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

ALL_MEMORY_MB = 2**40  # more than any machine has, so that the stage runs alone
GRACE = 20.0  # seconds after which an interrupted stage that has not ended is killed
# (limit, usage) of the memory of this process's control group, in versions 2 and 1 of cgroups
CGROUPS = (("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
           ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"))  # fmt: skip


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
    """The interface of an engine: a place where stages run.

    Attributes:
        cuda: whether its machines have a GPU; None if it is this machine, see `resolve.has_cuda`.
        cores: total number of CPU cores.
        gpus: number of GPUs that stages share; 0 if there is none, or on a cluster.
        is_remote: True if stages may run on other machines, which write to the folder of results.
    """

    cuda: bool | None
    cores: int
    gpus: int
    is_remote: bool

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

    def stop(self) -> None:
        """Interrupt the running tasks, and start no further ones. Does not wait for their end.

        May be called from any thread.
        """
        ...


class LocalEngine:
    """The engine that runs stages on this machine.

    Any number of threads may call `run`; each call waits for its resources.
    """

    cuda: bool | None = None
    is_remote = False

    def __init__(self, cores: list[int] | None = None, memory_mb: int | None = None, gpus: list[str] | None = None):
        """Select the resources to use; None for all that this process may use.

        Args:
            cores: numbers of the CPU cores.
            memory_mb: CPU memory in MB that stages may reserve together. None for the memory that is free now; then the
                free memory is also checked before each stage.
            gpus: numbers of the GPUs.
        """
        self._cores = sorted(os.sched_getaffinity(0)) if cores is None else list(cores)
        self._gpus = visible_gpus() if gpus is None else list(gpus)
        self.cores, self.gpus = len(self._cores), len(self._gpus)
        self.memory_mb = memory_mb if memory_mb is not None else free_memory_mb()
        self._asks_system = memory_mb is None
        self._reserved: dict[int, int] = {}  # running task -> its memory, MB
        self._running: set[subprocess.Popen[str]] = set()
        self._change, self._stopped, self._number = threading.Condition(), False, 0

    def run(self, task: Task, resources: Resources, lock: int, on_start: Callable[[], None]) -> StageResult:
        """See `Engine.run`. A stage that is killed (SIGKILL) beside other stages runs once more, alone.

        The usual reason for such a kill is a lack of memory.
        """
        result, others = self._run_once(task, resources, lock, on_start)
        if result.code == -signal.SIGKILL and others:  # probably out of memory: resume the stage while no other runs
            result, _ = self._run_once(task, replace(resources, memory_mb=ALL_MEMORY_MB), lock, on_start)
        return result

    def _run_once(
        self, task: Task, resources: Resources, lock: int, on_start: Callable[[], None]
    ) -> tuple[StageResult, int]:
        """Run a task once, and return its result and the number of other stages that ran when it ended."""
        with self._reserve(resources) as (cores, gpus):
            on_start()
            where = {"cores": len(cores), "on": cores} if resources.cores is not None else {}
            where |= {"gpus": ",".join(gpus)} if gpus and self.gpus > 1 else {}
            result = run_process(replace(task, line=task.line | where), lock, self._follow)
            others = len(self._reserved) - 1
        if result.interrupted:
            self._stopped = True  # nothing starts any more, but the artifact of a finished stage is moved into place
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
        """Register a process inside the context, so that `stop` can interrupt it."""
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
        """Wait for free cores, GPUs and memory, reserve them inside the context, and yield the core and GPU numbers."""
        core_count = min(resources.cores or self.cores, self.cores)
        gpu_count = min(resources.gpus, self.gpus)
        with self._change:
            self._number += 1
            number = self._number
            # A stage that asks for more memory than there is waits until no other stage runs.
            while not (self._stopped or self._fits(core_count, gpu_count, resources.memory_mb)):
                self._change.wait(1.0)  # a timeout, because free memory changes without a notification
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
        """Return whether the resources are free. They always are if no stage runs."""
        if not self._reserved:
            return True
        reserved = sum(self._reserved.values()) + memory_mb
        enough = reserved <= self.memory_mb and (not self._asks_system or memory_mb <= free_memory_mb())
        return cores <= len(self._cores) and gpus <= len(self._gpus) and enough


def free_memory_mb() -> int:
    """Return the free memory of this machine in MB, or that of this process's control group if it is less."""
    found = []
    with suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text().splitlines()
        found.append(int(next(line for line in lines if line.startswith("MemAvailable:")).split()[1]) * 1024)
    for limit, used in CGROUPS:
        with suppress(OSError, ValueError):  # the limit "max" is no number and means none
            found.append(int(Path(limit).read_text()) - int(Path(used).read_text()))
    return min(found, default=2**50) // 2**20


def visible_gpus() -> list[str]:
    """Return the GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them, or else their numbers as text."""
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
    """Run a task in a new process on this machine, and wait for its end.

    An interrupt (Ctrl-C) is passed on to the process. It is not raised here, because the stage may have finished; see
    `StageResult.interrupted`.

    Args:
        task: the work.
        lock: file descriptor of a lock that the process keeps open, too; None for no lock.
        follow: makes a context from the process, which is entered while the process runs.
        should_stop: called every second; if it returns True, the process is interrupted, and killed if it has not
            ended after GRACE seconds. None: never.
    """
    reader, writer = os.pipe()  # a pipe and not a file, because the answer may be that the disk is full
    line = json.dumps(task.line | {"result": writer, "lock": lock})
    answer: dict[str, Any] = {}
    interrupted = False
    with open(task.output, "a") if task.output else nullcontext() as output:
        # The process has a process group of its own, so that Ctrl-C reaches it only once, passed on from here.
        descriptors = (writer,) if lock is None else (lock, writer)
        process = start_worker(task.root, "run", pass_fds=descriptors, process_group=0, stdout=output, stderr=output)
    assert process.stdin
    os.close(writer)
    try:
        with follow(process):
            with suppress(BrokenPipeError):  # the worker may have ended already; its exit code is read below
                process.stdin.write(line + "\n")
                process.stdin.flush()  # the pipe stays open: when this process ends, it closes and the worker ends too
            code = _poll(process, should_stop) if should_stop else process.wait()
    except KeyboardInterrupt:
        code, interrupted = _interrupt(process), True
    finally:
        with suppress(BrokenPipeError):
            process.stdin.close()
        os.set_blocking(reader, False)  # else reading could wait for processes that the stage started
        with suppress(BlockingIOError), open(reader, "rb", buffering=0) as file:
            answer = json.loads(file.read(1 << 16) or "{}")
    return StageResult(answer, code, interrupted)


def _poll(process: "subprocess.Popen[str]", should_stop: Callable[[], bool]) -> int:
    """Wait for a process, interrupt it as soon as `should_stop` returns True, and return its exit code."""
    while not should_stop():
        with suppress(subprocess.TimeoutExpired):
            return process.wait(1.0)
    return _interrupt(process)


def _interrupt(process: "subprocess.Popen[str]") -> int:
    """Interrupt a process, kill it if it has not ended after GRACE seconds, and return its exit code."""
    process.send_signal(signal.SIGINT)
    try:
        return process.wait(GRACE)
    except (subprocess.TimeoutExpired, KeyboardInterrupt):
        process.kill()
        return process.wait()


# name of the engine -> (its class in <name>_engine.py, the package that this module imports)
ENGINES = {"ray": ("RayEngine", "ray"), "slurm": ("SlurmEngine", "submitit")}


def make_engine(name: str | None, address: str | None, root: Path, runs: Path) -> Engine:
    """Make the engine of this name.

    Args:
        name: "local", "ray" or "slurm"; None or "" for this machine (local).
        address: of the cluster, see the engine's class; None for its default.
        root: folder with pipeline.yaml and stages/.
        runs: folder of all results.

    Raises:
        Refused: the engine is unknown, its package is not installed, or the cluster cannot be reached; or an address is
            given for the local engine.
    """
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
        raise Refused(f"engine={name}: {library} is not installed; `pip install '.[cluster]'`") from None
    engine: Engine = getattr(module, kind)(address, root, runs)
    say(f"engine {name}: {engine.cores} cores")
    return engine
