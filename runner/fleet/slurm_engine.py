"""The engine for Slurm: each stage is a job that the library submitit submits.

All nodes must share the results, the scenes and this checkout at equal paths. A stage whose node was lost is submitted
again. This engine was not tried on a cluster: tests use submitit's local executor (address=local).
"""

import math
import os
import subprocess
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import submitit

from runner import Failed, Refused
from runner.fleet.retry import run_attempt
from runner.process import GRACE, Resources, StageResult, Task
from runner.text import display_path, format_error

RETRIES = 3  # number of times that a stage is submitted again after its node was lost
TIMEOUT_MINUTES = 24 * 60  # time limit of a job; the next job of the stage resumes from its checkpoint
MAX_JOBS = 64  # reported as the number of cores: it limits how many jobs are submitted at a time
POLL_SECONDS = 1.0  # time between two checks of a job's state
FOLDER = ".slurm"  # folder in runs/ with submitit's files of each job


class SlurmEngine:
    """The engine for Slurm, see `engine.Engine`.

    Its `address` is the name of a partition, None for the default partition, or "local" for processes on this machine.
    """

    is_remote, gpus = True, 0

    def __init__(self, address: str | None, root: Path, runs: Path):
        self._folder = runs / FOLDER
        try:
            self._executor = submitit.AutoExecutor(self._folder, cluster="local" if address == "local" else "slurm")
        except (RuntimeError, OSError) as error:
            raise Refused(f"engine=slurm: {format_error(error)}; address=local tries it without a cluster") from None
        self._local, self._partition = address == "local", address
        self.cuda: bool | None = None if self._local else _has_gpus(address)
        self.cores = (os.cpu_count() or 1) if self._local else MAX_JOBS
        self._jobs: set[submitit.Job[Any]] = set()
        self._stopped = False

    def run(self, task: Task, resources: Resources, lock: int, on_start: Callable[[], None]) -> StageResult:
        """Run a task as a job of Slurm, see `Engine.run`. Only the runner holds the lock, not the job.

        Raises:
            Failed: the job was lost more than `RETRIES` times.
        """
        cores = resources.cores or 1
        options = {"cpus_per_task": cores, "gpus_per_node": resources.gpus, "mem_gb": resources.memory_mb / 1024 or 1}
        options |= {"timeout_min": TIMEOUT_MINUTES, "name": str(task.line["stage"])}
        options |= {"slurm_partition": self._partition} if self._partition and not self._local else {}
        work = partial(run_attempt, Task(task.root, task.line | {"cores": cores}, task.output))
        result = None
        for _ in range(RETRIES + 1):
            if self._stopped:
                raise KeyboardInterrupt
            self._executor.update_parameters(**options)
            job = self._executor.submit(work)
            self._jobs.add(job)
            on_start()
            try:
                result = self._wait(job)
                break
            except (submitit.core.utils.UncompletedJobError, submitit.core.utils.FailedJobError) as error:
                last_error = error
            finally:
                self._jobs.discard(job)
        if self._stopped and (result is None or result.code != 0):
            raise KeyboardInterrupt
        if result:
            return result
        reason = f"{format_error(last_error)[:300]} (all of it in {display_path(self._folder)})"
        raise Failed(f"{task.line['stage']}: its job was lost {RETRIES + 1} times: {reason}")

    def _wait(self, job: submitit.Job[Any]) -> StageResult:
        """Wait for a job and return its result; on Ctrl-C, stop the engine and wait GRACE + 5 seconds at most."""
        until = math.inf
        while not job.done() and time.monotonic() < until:
            try:
                time.sleep(POLL_SECONDS)
            except KeyboardInterrupt:
                self.stop()
                until = time.monotonic() + GRACE + 5
        if not job.done():
            raise KeyboardInterrupt
        result: StageResult = job.result()
        return result

    def stop(self) -> None:
        """See `Engine.stop`."""
        self._stopped = True
        for job in list(self._jobs):
            job.cancel()


def _has_gpus(partition: str | None) -> bool:
    """Return whether the nodes of a partition (None: all nodes) have GPUs."""
    command = ["sinfo", "--noheader", "--format=%G", *(["--partition", partition] if partition else [])]
    return "gpu" in subprocess.run(command, capture_output=True, text=True).stdout
