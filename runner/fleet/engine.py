"""Engines for many scenes, which run the processes of stages with given cores, memory and GPUs.

The engine of this module shares this machine among scenes; those of ray_engine.py and slurm_engine.py use clusters.
"""

import importlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from runner import Refused, process, say
from runner.durations import receipts_of_variants
from runner.files import list_files
from runner.process import Resources, StageResult, Task, run_process
from runner.resolve import ResolvedJob

ALL_MEMORY_MB = 2**40  # more than any machine has, so that the stage runs alone
# (limit, usage) of the memory of this process's control group, in versions 2 and 1 of cgroups
CGROUPS = (("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
           ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"))  # fmt: skip


class Engine(process.Engine, Protocol):
    """The interface of an engine that several threads may use at a time.

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
            result = run_process(replace(task, line=task.line | where), lock, lambda: self._stopped)
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
        """Return whether the resources are free; True whenever no stage runs."""
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


def expected_memory_mb(job: ResolvedJob, stage: str, needs: dict[str, Path | None]) -> int:
    """Estimate the CPU memory in MB to reserve for a stage.

    The result is 10 % above the largest peak of this stage in the receipts of the scene and its variants, of any
    profile. Before the first run it follows from the size of all files in the folders of `needs`, by the table `memory`
    of pipeline.yaml; 0 if the stage is not in the table.

    Args:
        job: the job.
        stage: name of the stage.
        needs: need -> folder; None if the need is skipped.
    """
    if peaks := [r["peak_memory_mb"] for r in receipts_of_variants(job, stage) if r.get("peak_memory_mb")]:
        return round(1.1 * max(peaks))
    each = job.pipeline.memory.get(stage)
    read = (path for folder in needs.values() if folder for path in list_files(folder))
    return round(each.mb + each.each * sum(path.stat().st_size for path in read) / 2**20) if each else 0


def visible_gpus() -> list[str]:
    """Return the GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them, or else their numbers as text."""
    listed = os.environ.get("CUDA_VISIBLE_DEVICES")
    if listed is not None:
        return [number for number in listed.split(",") if number not in ("", "-1")]
    return sorted((path.name.removeprefix("nvidia") for path in Path("/dev").glob("nvidia[0-9]*")), key=int)


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
        module = importlib.import_module(f"runner.fleet.{name}_engine")
    except ImportError as error:
        if error.name != library:
            raise
        raise Refused(f"engine={name}: {library} is not installed; `pip install '.[cluster]'`") from None
    engine: Engine = getattr(module, kind)(address, root, runs)
    say(f"engine {name}: {engine.cores} cores")
    return engine
