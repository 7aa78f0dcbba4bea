"""Stages on a Ray cluster whose machines share the folder of results, the scenes and this checkout, at equal paths.

Ray places each stage's process by its cores, cards and memory, and places it anew where a machine is lost (lost.py)."""

import logging
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path

import ray
from ray.exceptions import RayError, TaskCancelledError

from runner import Failed, Refused
from runner.engine import GRACE, Ended, Needs, Task
from runner.files import told
from runner.retry import attempt

RETRIES = 3  # on other machines, of a stage whose machine was lost


class Ray:
    """See engine.Engine. `address`: of a running cluster, as ray.init takes it; None: that of $RAY_ADDRESS, or one that
    runs on this machine."""

    shares = True

    def __init__(self, address: str | None, root: Path, runs: Path):
        here = os.pathsep.join(dict.fromkeys([str(root), str(Path(__file__).resolve().parent.parent)]))
        try:
            ray.init(
                address=address or "auto",
                runtime_env={"env_vars": {"PYTHONPATH": here}},
                log_to_driver=False,
                logging_level=logging.ERROR,
            )
        except (RayError, ConnectionError, ValueError, OSError, RuntimeError) as error:
            raise Refused(f"address={address or 'auto'}: no Ray cluster there: {told(error)}") from None
        has = ray.cluster_resources()
        self.cores, self._cards = int(has.get("CPU", 0)), has.get("GPU", 0)
        self.cuda = self._cards > 0
        self._memory_mb = max((node["Resources"].get("memory", 0) for node in ray.nodes()), default=0) / 2**20
        if not self.cores:
            raise Refused(f"address={address or 'auto'}: the cluster has no core")
        self._refs: set[ray.ObjectRef] = set()
        self._stopped = False

    def run(self, task: Task, needs: Needs, lock: int, begun: Callable[[], None]) -> Ended:
        """The lock stays with the runner. A stage that asks for more memory than any machine has gets all of one."""
        if self._stopped:
            raise KeyboardInterrupt
        cores = needs.cores or 1
        memory_mb = min(needs.memory_mb, 0.95 * self._memory_mb)
        options = {"num_cpus": cores, "num_gpus": needs.gpus, "memory": int(memory_mb * 2**20)}
        line = task.line | {"cores": cores}
        ref = _work.options(**options, name=str(line["stage"])).remote(Task(task.root, line, task.output))
        self._refs.add(ref)
        if self._stopped:  # meanwhile
            ray.cancel(ref)
        begun()
        try:
            ended = self._ended(ref)
        except TaskCancelledError:  # before it began
            raise KeyboardInterrupt from None
        except RayError as error:
            if self._stopped:
                raise KeyboardInterrupt from None
            raise Failed(f"{line['stage']}: its machine was lost {RETRIES + 1} times: {told(error)[:400]}") from None
        finally:
            self._refs.discard(ref)
        if self._stopped and ended.code != 0:
            raise KeyboardInterrupt
        return ended

    def _ended(self, ref: "ray.ObjectRef[Ended]") -> Ended:
        """Interrupted, it waits for the stage to have ended: with this process Ray would end it at once."""
        try:
            return ray.get(ref)
        except KeyboardInterrupt:
            self.stop()
            return ray.get(ref, timeout=GRACE + 5)

    def stop(self) -> None:
        self._stopped = True
        for ref in list(self._refs):
            ray.cancel(ref)


_told = threading.Event()  # in a process of Ray's that works for this runner: it is to stop, for good


def work(task: Task) -> Ended:
    """On the machine that works. Ray cancels by a KeyboardInterrupt in this thread, wherever it is, and what has just
    been finished is thrown away; so it is made a word that is heeded where there is something to end."""
    signal.signal(signal.SIGINT, lambda *_: _told.set())
    if _told.is_set():
        return Ended({}, -signal.SIGINT)
    return attempt(task, _told.is_set)


_work = ray.remote(max_retries=RETRIES)(work)
