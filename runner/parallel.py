"""Many runs, several scenes at once where there are cores and memory for them."""

import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count, groupby
from pathlib import Path

from runner import said_to, say
from runner.engine import GRACE, Engine
from runner.execute import Work, run_scene
from runner.files import told
from runner.keys import Hashes
from runner.progress import Progress
from runner.resolve import Request

OUTPUT = "output.log"  # in a run's folder: what it said while others ran beside it
FAR = 256  # scenes at once, at most, where others do the work


@dataclass(frozen=True)
class Run:
    """One to be done. `name`: what people read; runs of one `group`, which are neighbours, are done one after another,
    since they share what is equal. `announced`: a line said first where nothing runs beside it."""

    name: str
    group: str
    home: Path
    request: Request
    announced: str = ""


@dataclass(frozen=True)
class Outcome:
    """What became of a run: each stage's artifact, what went wrong, seconds of wall clock."""

    stages: dict[str, Path | None]
    error: str | None
    seconds: float


def do_all(
    runs: Sequence[Run],
    engine: Engine,
    cores: int | None,
    hashes: Hashes,
    stages: list[str],
    ended: Callable[[int, Outcome], None],
) -> None:
    """Bring each up to date; one that fails stops no other. `ended` is told each one's place among `runs` and its
    outcome, one at a time.

    cores: that each stage gets, None: an equal part of the engine's for every group, at least one. It stays the same to
    the end, so that no result depends on which of them ended first."""
    groups = [list(each) for _, each in groupby(range(len(runs)), key=lambda place: runs[place].group)]
    each = min(cores or max(1, engine.cores // max(1, len(groups))), engine.cores)
    at_once = min(len(groups), engine.cores // each, FAR)
    if at_once == 1 and not engine.shares:
        for place, run in enumerate(runs):
            if run.announced:
                say(run.announced)
            ended(place, _outcome(run, hashes, Work(engine, cores and each)))
        return
    said = f"{len(groups)} scenes, {at_once} at once, {each} core{'s' * (each > 1)} each"
    homes = [run.home for run in runs]
    with Progress([run.name for run in runs], homes, stages, at_once, said) as progress:
        _in_threads(runs, groups, at_once, partial(_watched, progress, hashes, Work(engine, each)), ended, engine)


def _in_threads(
    runs: Sequence[Run],
    groups: list[list[int]],
    at_once: int,
    do: Callable[[int, Run], Outcome],
    ended: Callable[[int, Outcome], None],
    engine: Engine,
) -> None:
    order, one_at_a_time = count(), threading.Lock()

    def work() -> None:
        while (number := next(order)) < len(groups):
            for place in groups[number]:
                outcome = do(place, runs[place])
                with one_at_a_time:
                    ended(place, outcome)

    wrong: list[BaseException] = []
    threads = [threading.Thread(target=_kept, args=(work, wrong), daemon=True) for _ in range(at_once)]
    for thread in threads:
        thread.start()
    try:
        for thread in threads:
            while thread.is_alive():
                thread.join(0.5)
    except KeyboardInterrupt:
        say("stopping")
        engine.stop()
        until = time.monotonic() + GRACE + 5  # a thread that waits for a lock is left behind
        for thread in threads:
            thread.join(max(0, until - time.monotonic()))
        raise
    if wrong:
        raise wrong[0]


def _kept(work: Callable[[], None], wrong: list[BaseException]) -> None:
    """Do it, and keep what goes wrong beside the stages, such as a table on a full disk."""
    try:
        work()
    except BaseException as error:
        wrong.append(error)


def _watched(progress: Progress, hashes: Hashes, work: Work, place: int, run: Run) -> Outcome:
    """Do one whose words go to a file, while its progress is watched."""
    run.home.mkdir(parents=True, exist_ok=True)
    output = run.home / OUTPUT
    with open(output, "w", encoding="utf-8") as file, said_to(lambda text: print(text, file=file, flush=True)):
        outcome = _outcome(run, hashes, replace(work, output=output, watch=partial(progress.stage, place)))
    progress.ended(place, outcome.error, outcome.seconds)
    return outcome


def _outcome(run: Run, hashes: Hashes, work: Work) -> Outcome:
    began = time.monotonic()
    try:
        return Outcome(run_scene(run.request, "all", hashes, work), None, time.monotonic() - began)
    except Exception as error:  # of whatever kind: it must not keep others waiting
        if work.output is None:
            print(f"error: {told(error)}", file=sys.stderr, flush=True)
        return Outcome({}, told(error), time.monotonic() - began)
