"""The engine for Ray clusters, whose machines must share the results, the scenes and this checkout at equal paths.

Ray selects a machine for each stage's process by cores, GPUs and memory. If a machine is lost, the stage runs again on
another one (retry.py).
"""

import logging
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path

import ray
from ray.exceptions import RayError, TaskCancelledError

from runner import Failed, Refused
from runner.fleet.retry import run_attempt
from runner.process import GRACE, PROJECT, Resources, StageResult, Task
from runner.text import format_error

RETRIES = 3  # number of times that a stage is started again after its machine was lost


class RayEngine:
    """The engine for Ray, see `engine.Engine`.

    Its `address` is that of a running cluster, as ray.init takes it; None for $RAY_ADDRESS, or else a cluster that runs
    on this machine.
    """

    is_remote, gpus = True, 0

    def __init__(self, address: str | None, root: Path, runs: Path):
        here = os.pathsep.join(dict.fromkeys([str(root), str(PROJECT)]))
        try:
            ray.init(
                address=address or "auto",
                runtime_env={"env_vars": {"PYTHONPATH": here}},
                log_to_driver=False,
                logging_level=logging.ERROR,
            )
        except (RayError, ConnectionError, ValueError, OSError, RuntimeError) as error:
            raise Refused(f"address={address or 'auto'}: no Ray cluster there: {format_error(error)}") from None
        total = ray.cluster_resources()
        self.cores, self._gpus = int(total.get("CPU", 0)), total.get("GPU", 0)
        self.cuda = self._gpus > 0
        self._memory_mb = max((node["Resources"].get("memory", 0) for node in ray.nodes()), default=0) / 2**20
        if not self.cores:
            raise Refused(f"address={address or 'auto'}: the cluster has no core")
        self._refs: set[ray.ObjectRef] = set()
        self._stopped = False

    def run(self, task: Task, resources: Resources, lock: int, on_start: Callable[[], None]) -> StageResult:
        """Run a task on a machine of the cluster, see `Engine.run`. Only the runner holds the lock.

        A stage that asks for more memory than any machine has reserves 95 % of the memory of the largest machine.

        Raises:
            Failed: the machine of the stage was lost more than `RETRIES` times.
        """
        if self._stopped:
            raise KeyboardInterrupt
        cores = resources.cores or 1
        memory_mb = min(resources.memory_mb, 0.95 * self._memory_mb)
        options = {"num_cpus": cores, "num_gpus": resources.gpus, "memory": int(memory_mb * 2**20)}
        line = task.line | {"cores": cores}
        ref = _remote_task.options(**options, name=str(line["stage"])).remote(Task(task.root, line, task.output))
        self._refs.add(ref)
        if self._stopped:  # `stop` was called while the task was submitted
            ray.cancel(ref)
        on_start()
        try:
            result = self._wait(ref)
        except TaskCancelledError:  # the task was cancelled before it started
            raise KeyboardInterrupt from None
        except RayError as error:
            if self._stopped:
                raise KeyboardInterrupt from None
            raise Failed(
                f"{line['stage']}: its machine was lost {RETRIES + 1} times: {format_error(error)[:400]}"
            ) from None
        finally:
            self._refs.discard(ref)
        if self._stopped and result.code != 0:
            raise KeyboardInterrupt
        return result

    def _wait(self, ref: "ray.ObjectRef[StageResult]") -> StageResult:
        """Wait for a task and return its result; on an interrupt (Ctrl-C), stop the engine and wait for the stage."""
        try:
            return ray.get(ref)
        except KeyboardInterrupt:
            self.stop()
            return ray.get(ref, timeout=GRACE + 5)  # Ray kills the stage as soon as this process ends

    def stop(self) -> None:
        """See `Engine.stop`."""
        self._stopped = True
        for ref in list(self._refs):
            ray.cancel(ref)


_stop = threading.Event()  # in a process of Ray: set when the runner was stopped


def run_task(task: Task) -> StageResult:
    """Run a task on the machine that Ray selected; this function runs there.

    Ray cancels a task by a KeyboardInterrupt, which may be raised anywhere in this thread and could discard a finished
    result. So the signal only sets a flag here, which is read while the stage's process runs.
    """
    signal.signal(signal.SIGINT, lambda *_: _stop.set())
    if _stop.is_set():
        return StageResult({}, -signal.SIGINT)
    return run_attempt(task, _stop.is_set)


_remote_task = ray.remote(max_retries=RETRIES)(run_task)
