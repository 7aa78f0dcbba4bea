"""Parallel execution of several scenes, as far as cores and memory allow."""

import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count, groupby
from pathlib import Path

from runner import OUTPUT, say
from runner.execute import Execution, run_scene
from runner.fleet.engine import Engine, expected_memory_mb
from runner.fleet.progress import Progress
from runner.keys import Hashes
from runner.process import GRACE
from runner.resolve import Request
from runner.text import format_error

OUTPUT_FILE = "output.log"  # file in a run's folder with everything that it prints, if runs are parallel
MAX_SCENES = 256  # largest number of scenes at once, on a cluster


@dataclass(frozen=True)
class SceneRun:
    """A run that is to be done: one scene, or one variant of it.

    Attributes:
        name: name for messages.
        group: name of a group. Runs of a group share artifacts and thus run one after another; they must be neighbors
            in the list of runs.
        home: folder of the run in runs/.
        request: the scene and its options.
        announcement: text that is printed before the run if runs are not parallel.
    """

    name: str
    group: str
    home: Path
    request: Request
    announcement: str = ""


@dataclass(frozen=True)
class Outcome:
    """The result of a run.

    Attributes:
        stages: stage -> folder of its artifact, None if it was skipped; empty if the run failed.
        error: message of the error; None if the run succeeded.
        seconds: duration, wall clock.
    """

    stages: dict[str, Path | None]
    error: str | None
    seconds: float


def run_all(
    runs: Sequence[SceneRun],
    execution: Execution,
    hashes: Hashes,
    stages: list[str],
    on_end: Callable[[int, Outcome], None],
) -> None:
    """Do several runs, in parallel if cores allow. If one fails, the others go on.

    By default each group gets an equal part of the engine's cores, at least one. With n GPUs at most n stages use a GPU
    at a time, and each of them gets at least the part 1 / (n + 1) of the cores. The number of cores of a stage does not
    change when other runs end, so that no result depends on the order in which runs end.

    If runs are parallel or on a cluster, each run's output goes to output.log in its home, and a table of the progress
    is displayed instead.

    Args:
        runs: the runs; those of a group must be neighbors.
        execution: an engine for several scenes, and number of cores of each stage; its other settings are not used.
        hashes: the cache of hashes.
        stages: names of all stages, for the display of progress.
        on_end: called after each run, failed or not, with its index in `runs` and its outcome, never by two threads at
            once. An error that it raises is raised here.

    Raises:
        KeyboardInterrupt: the user interrupted the runs (Ctrl-C).
    """
    engine: Engine = execution.engine
    cores = execution.cores
    groups = [list(places) for _, places in groupby(range(len(runs)), key=lambda place: runs[place].group)]
    cores_each = min(cores or max(1, engine.cores // max(1, len(groups))), engine.cores)
    at_once = min(len(groups), engine.cores // cores_each, MAX_SCENES)
    if at_once == 1 and not engine.is_remote:
        for place, run in enumerate(runs):
            if run.announcement:
                say(run.announcement)
            on_end(place, _run(run, hashes, Execution(engine, cores and cores_each, memory_mb=expected_memory_mb)))
        return
    gpu_cores = None if cores or not engine.gpus else max(cores_each, engine.cores // (engine.gpus + 1))
    header = f"{len(groups)} scenes, {at_once} at once, {cores_each} core{'s' * (cores_each > 1)} each"
    homes = [run.home for run in runs]
    with Progress([run.name for run in runs], homes, stages, at_once, header) as progress:
        shared = Execution(engine, cores_each, gpu_cores, memory_mb=expected_memory_mb)
        run_one = partial(_run_with_progress, progress, hashes, shared)
        _run_in_threads(runs, groups, at_once, run_one, on_end, engine)


def _run_in_threads(
    runs: Sequence[SceneRun],
    groups: list[list[int]],
    at_once: int,
    run_one: Callable[[int, SceneRun], Outcome],
    on_end: Callable[[int, Outcome], None],
    engine: Engine,
) -> None:
    """Do the runs of all groups (lists of indices), `at_once` groups at a time; an interrupt stops the engine."""
    order, one_at_a_time = count(), threading.Lock()

    def run_groups() -> None:
        while (number := next(order)) < len(groups):
            for place in groups[number]:
                outcome = run_one(place, runs[place])
                with one_at_a_time:
                    on_end(place, outcome)

    errors: list[BaseException] = []
    threads = [threading.Thread(target=_collect_errors, args=(run_groups, errors), daemon=True) for _ in range(at_once)]
    for thread in threads:
        thread.start()
    try:
        for thread in threads:
            while thread.is_alive():
                thread.join(0.5)
    except KeyboardInterrupt:
        say("stopping")
        engine.stop()
        until = time.monotonic() + GRACE + 5  # after that, e.g. a thread that waits for a lock is abandoned
        for thread in threads:
            thread.join(max(0, until - time.monotonic()))
        raise
    if errors:  # e.g. of `on_end`
        raise errors[0]


def _collect_errors(function: Callable[[], None], errors: list[BaseException]) -> None:
    """Call a function, and append the error that it raises to `errors`."""
    try:
        function()
    except BaseException as error:  # e.g. a table cannot be written; errors of stages are part of an outcome
        errors.append(error)


def _run_with_progress(progress: Progress, hashes: Hashes, execution: Execution, place: int, run: SceneRun) -> Outcome:
    """Do one run, with its output in a file, and report its progress. `place` is the index of the run."""
    run.home.mkdir(parents=True, exist_ok=True)
    output = run.home / OUTPUT_FILE
    with open(output, "w", encoding="utf-8") as file:
        token = OUTPUT.set(file)
        try:
            outcome = _run(run, hashes, replace(execution, output=output, on_change=partial(progress.update, place)))
        finally:
            OUTPUT.reset(token)
    progress.end(place, outcome.error, outcome.seconds)
    return outcome


def _run(run: SceneRun, hashes: Hashes, execution: Execution) -> Outcome:
    """Do one run. An error of any kind is not raised but becomes part of the outcome, because other runs go on."""
    started = time.monotonic()
    try:
        return Outcome(run_scene(run.request, "all", hashes, execution), None, time.monotonic() - started)
    except Exception as error:
        if execution.output is None:
            print(f"error: {format_error(error)}", file=sys.stderr, flush=True)
        return Outcome({}, format_error(error), time.monotonic() - started)
