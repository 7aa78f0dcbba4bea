"""Stages as jobs of Slurm, one each, by submitit; results, scenes and this checkout lie on a folder that all nodes
share. Slurm places them; a stage whose node was lost is sent again. No cluster has run this: tests use submitit's own
executor of this machine (address=local)."""

import os
import subprocess
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import submitit

from runner import Failed, Refused
from runner.engine import Ended, Needs, Task
from runner.files import shown, told
from runner.lost import attempt

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
        for _ in range(RETRIES + 1):
            if self._stopped:
                raise KeyboardInterrupt
            self._executor.update_parameters(**asked)
            job = self._executor.submit(work)
            self._jobs.add(job)
            begun()
            try:
                while not job.done():
                    time.sleep(EVERY)
                return job.result()
            except (submitit.core.utils.UncompletedJobError, submitit.core.utils.FailedJobError) as error:
                lost = error
            except KeyboardInterrupt:
                self.stop()
                raise
            finally:
                self._jobs.discard(job)
        if self._stopped:
            raise KeyboardInterrupt
        said = f"{told(lost)[:300]} (all of it in {shown(self._folder)})"
        raise Failed(f"{task.line['stage']}: its job was lost {RETRIES + 1} times: {said}")

    def stop(self) -> None:
        self._stopped = True
        for job in list(self._jobs):
            job.cancel()


def _has_cards(partition: str | None) -> bool:
    """Does Slurm say that its nodes, or those of a partition, have any?"""
    command = ["sinfo", "--noheader", "--format=%G", *(["--partition", partition] if partition else [])]
    return "gpu" in subprocess.run(command, capture_output=True, text=True).stdout
