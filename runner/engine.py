"""Where a stage's process runs, with how many cores, how much memory, which card. An engine takes a stage's task and
needs, and tells how it ended; the one here is this machine, on_ray.py and on_slurm.py are clusters."""

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
from runner.resolve import child

ALL = 2**40  # MB: more than any machine has
GRACE = 20.0  # seconds an interrupted stage has to end by itself
CGROUPS = (("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
           ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"))  # fmt: skip


@dataclass(frozen=True)
class Needs:
    """What a stage is to have: cores (None: all there are), cards, memory of the CPU in MB."""

    cores: int | None
    gpus: int
    memory_mb: int


@dataclass(frozen=True)
class Task:
    """One stage's work. `line`: what child.py reads, but for what the process is given here; paths as text.

    `output`: the file to which what the stage prints is added, None: where the runner's own output goes."""

    root: Path
    line: dict[str, Any]
    output: Path | None = None


@dataclass(frozen=True)
class Ended:
    """What a stage's process told (see child.run), empty where it told nothing, and its exit code; negative: by a
    signal. interrupted: who waited for it was."""

    answer: dict[str, Any]
    code: int
    interrupted: bool = False


class Engine(Protocol):
    """cuda: has it a card? None: what this machine has. cores: of which stages may get some. shares: do other machines
    work in the folder of results?"""

    cuda: bool | None
    cores: int
    shares: bool

    def run(self, task: Task, needs: Needs, lock: int, begun: Callable[[], None]) -> Ended:
        """Do the work, `begun` called when it has what it needs. `lock`: the file that who works must hold open.

        Raises KeyboardInterrupt where the engine was told to stop, Refused where it can never have what it needs."""
        ...

    def stop(self) -> None:
        """End what runs, and start nothing more; may be called from another thread."""
        ...


class Local:
    """This machine. Any number of threads may ask it to run a stage; it lets in as many as there is room for."""

    cuda: bool | None = None
    shares = False

    def __init__(self, cores: list[int] | None = None, memory_mb: int | None = None, cards: list[str] | None = None):
        """Numbers of cores, memory, numbers of cards; those that this process may use where they are not given."""
        self._cores = sorted(os.sched_getaffinity(0)) if cores is None else list(cores)
        self._cards = visible_cards() if cards is None else list(cards)
        self.cores, self._all_cards = len(self._cores), len(self._cards)
        self.memory_mb = memory_mb if memory_mb is not None else free_memory_mb()
        self._asks_system = memory_mb is None
        self._given: dict[int, int] = {}  # running task -> memory promised to it
        self._running: set[subprocess.Popen[str]] = set()
        self._change, self._stopped, self._number = threading.Condition(), False, 0

    def run(self, task: Task, needs: Needs, lock: int, begun: Callable[[], None]) -> Ended:
        ended, beside = self._once(task, needs, lock, begun)
        if ended.code == -signal.SIGKILL and beside:  # memory ran out, it seems: it goes on alone
            ended, _ = self._once(task, replace(needs, memory_mb=ALL), lock, begun)
        return ended

    def _once(self, task: Task, needs: Needs, lock: int, begun: Callable[[], None]) -> tuple[Ended, int]:
        """How it ended, and how many stages ran beside it then."""
        with self._room(needs) as (cores, cards):
            begun()
            where = {"cores": len(cores), "on": cores} if needs.cores is not None else {}
            where |= {"cards": ",".join(cards)} if cards and self._all_cards > 1 else {}
            ended = carry_out(replace(task, line=task.line | where), lock, self._follow)
            beside = len(self._given) - 1
        if ended.interrupted:
            self._stopped = True  # what had finished is put in place, and nothing begun after it
        if self._stopped and ended.code != 0:
            raise KeyboardInterrupt
        return ended, beside

    def stop(self) -> None:
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
    def _room(self, needs: Needs) -> Iterator[tuple[list[int], list[str]]]:
        """Cores and cards for a stage, as soon as they and its memory are free. One that wants more than there is of
        cores or memory gets it all, alone."""
        wanted = min(needs.cores or self.cores, self.cores)
        cards_wanted = min(needs.gpus, self._all_cards)
        with self._change:
            self._number += 1
            mine = self._number
            while not (self._stopped or self._fits(wanted, cards_wanted, needs.memory_mb)):
                self._change.wait(1.0)  # free memory changes without telling
            if self._stopped:
                raise KeyboardInterrupt
            cores, self._cores = self._cores[:wanted], self._cores[wanted:]
            cards, self._cards = self._cards[:cards_wanted], self._cards[cards_wanted:]
            self._given[mine] = needs.memory_mb
        try:
            yield cores, cards
        finally:
            with self._change:
                self._cores, self._cards = sorted(self._cores + cores), sorted(self._cards + cards)
                del self._given[mine]
                self._change.notify_all()

    def _fits(self, cores: int, cards: int, memory_mb: int) -> bool:
        if not self._given:
            return True
        promised = sum(self._given.values()) + memory_mb
        enough = promised <= self.memory_mb and (not self._asks_system or memory_mb <= free_memory_mb())
        return cores <= len(self._cores) and cards <= len(self._cards) and enough


def free_memory_mb() -> int:
    """What this machine, or the group this process is held in, has left."""
    found = []
    with suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text().splitlines()
        found.append(int(next(line for line in lines if line.startswith("MemAvailable:")).split()[1]) * 1024)
    for limit, used in CGROUPS:
        with suppress(OSError, ValueError):  # "max": no limit
            found.append(int(Path(limit).read_text()) - int(Path(used).read_text()))
    return min(found, default=2**50) // 2**20


def visible_cards() -> list[str]:
    """Numbers of the cards that this process may use."""
    said = os.environ.get("CUDA_VISIBLE_DEVICES")
    if said is not None:
        return [number for number in said.split(",") if number not in ("", "-1")]
    return sorted((path.name.removeprefix("nvidia") for path in Path("/dev").glob("nvidia[0-9]*")), key=int)


def carry_out(
    task: Task,
    lock: int | None = None,
    follow: Callable[[Any], Any] = nullcontext,
    told: Callable[[], bool] | None = None,
) -> Ended:
    """Do a task in a fresh process of this machine, and wait for its end. An interrupt is passed on to it, and not
    raised: it may have finished.

    lock: an open file that the process holds, too. follow: a context, given the process, while that runs. told: asked
    every second whether to interrupt it, where no signal comes."""
    heard, result = os.pipe()  # no file: that there is no room for one may be what must be told
    line = json.dumps(task.line | {"result": result, "lock": lock})
    answer: dict[str, Any] = {}
    interrupted = False
    with open(task.output, "a") if task.output else nullcontext() as output:
        # A process group of its own: Ctrl-C reaches it once, from here.
        held = (result,) if lock is None else (lock, result)
        process = child(task.root, "run", pass_fds=held, process_group=0, stdout=output, stderr=output)
    assert process.stdin
    os.close(result)
    try:
        with follow(process):
            with suppress(BrokenPipeError):  # a child that is gone already has its code below
                process.stdin.write(line + "\n")
                process.stdin.flush()  # and left open: the child ends when this process does
            code = _code_of(process, told) if told else process.wait()
    except KeyboardInterrupt:
        code, interrupted = _interrupted(process), True
    finally:
        with suppress(BrokenPipeError):
            process.stdin.close()
        os.set_blocking(heard, False)  # what a stage has started may live on, and hold its end open
        with suppress(BlockingIOError), open(heard, "rb", buffering=0) as file:
            answer = json.loads(file.read(1 << 16) or "{}")
    return Ended(answer, code, interrupted)


def _code_of(process: "subprocess.Popen[str]", told: Callable[[], bool]) -> int:
    while not told():
        with suppress(subprocess.TimeoutExpired):
            return process.wait(1.0)
    return _interrupted(process)


def _interrupted(process: "subprocess.Popen[str]") -> int:
    process.send_signal(signal.SIGINT)
    try:
        return process.wait(GRACE)
    except (subprocess.TimeoutExpired, KeyboardInterrupt):
        process.kill()
        return process.wait()


ENGINES = {"ray": ("Ray", "ray"), "slurm": ("Slurm", "submitit")}  # name -> class in on_<name>.py, what it imports


def chosen(name: str | None, address: str | None, root: Path, runs: Path) -> Engine:
    """The engine that a command asks for, this machine where it asks for none. Refused where it cannot be had."""
    if name in (None, "", "local"):
        if address:
            raise Refused(f"address={address}: of which engine? For example engine=ray address={address}")
        return Local()
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
