"""Stages as jobs of Slurm, one each, by submitit; results, scenes and this checkout lie on a folder that all nodes
share. Slurm places them; a stage whose node was lost is sent again. No cluster has run this: tests use submitit's own
executor of this machine (address=local)."""

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
from runner.engine import GRACE, Ended, Needs, Task
from runner.files import shown, told
from runner.retry import attempt

RETRIES = 3  # of a stage whose node was lost
MINUTES = 24 * 60  # that a stage may take; what it has done by then is gone on with
AT_ONCE = 64  # jobs that are sent at once
EVERY = 1.0  # seconds between looks at a job
FOLDER = ".slurm"  # in the folder of results: what submitit keeps of each job


class Slurm:
    """See engine.Engine. `address`: a partition, None: the default one; `local`: processes of this machine."""

    shares = True

    def __init__(self, address: str | None, root: Path, runs: Path):
        self._folder = runs / FOLDER
        try:
            self._executor = submitit.AutoExecutor(self._folder, cluster="local" if address == "local" else "slurm")
        except (RuntimeError, OSError) as error:
            raise Refused(f"engine=slurm: {told(error)}; address=local tries it without a cluster") from None
        self._local, self._partition = address == "local", address
        self.cuda: bool | None = None if self._local else _has_cards(address)
        self.cores = (os.cpu_count() or 1) if self._local else AT_ONCE
        self._jobs: set[submitit.Job[Any]] = set()
        self._stopped = False

    def run(self, task: Task, needs: Needs, lock: int, begun: Callable[[], None]) -> Ended:
        """The lock stays with the runner."""
        cores = needs.cores or 1
        asked = {"cpus_per_task": cores, "gpus_per_node": needs.gpus, "mem_gb": needs.memory_mb / 1024 or 1}
        asked |= {"timeout_min": MINUTES, "name": str(task.line["stage"])}
        asked |= {"slurm_partition": self._partition} if self._partition and not self._local else {}
        work = partial(attempt, Task(task.root, task.line | {"cores": cores}, task.output))
        ended = None
        for _ in range(RETRIES + 1):
            if self._stopped:
                raise KeyboardInterrupt
            self._executor.update_parameters(**asked)
            job = self._executor.submit(work)
            self._jobs.add(job)
            begun()
            try:
                ended = self._ended(job)
                break
            except (submitit.core.utils.UncompletedJobError, submitit.core.utils.FailedJobError) as error:
                lost = error
            finally:
                self._jobs.discard(job)
        if self._stopped and (ended is None or ended.code != 0):
            raise KeyboardInterrupt
        if ended:
            return ended
        said = f"{told(lost)[:300]} (all of it in {shown(self._folder)})"
        raise Failed(f"{task.line['stage']}: its job was lost {RETRIES + 1} times: {said}")

    def _ended(self, job: submitit.Job[Any]) -> Ended:
        """Interrupted, it gives the stage time to end."""
        until = math.inf
        while not job.done() and time.monotonic() < until:
            try:
                time.sleep(EVERY)
            except KeyboardInterrupt:
                self.stop()
                until = time.monotonic() + GRACE + 5
        if not job.done():
            raise KeyboardInterrupt
        ended: Ended = job.result()
        return ended

    def stop(self) -> None:
        self._stopped = True
        for job in list(self._jobs):
            job.cancel()


def _has_cards(partition: str | None) -> bool:
    """Does Slurm say that its nodes, or those of a partition, have any?"""
    command = ["sinfo", "--noheader", "--format=%G", *(["--partition", partition] if partition else [])]
    return "gpu" in subprocess.run(command, capture_output=True, text=True).stdout
