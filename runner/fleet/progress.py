"""Display of the progress of many runs: a live table on a terminal, or else a line per event.

A run is one scene, or a variant of one, with all stages.
"""

import shutil
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from runner import say
from runner.files import read_receipt
from runner.text import format_seconds

MAX_RECEIPTS = 50  # largest number of runs whose receipts are read for the expected duration of stages
REDRAW_SECONDS = 1.0  # time between two drawings of the table
WAITS, RUNS = "waits", "runs"  # states of a stage: it waits for cores and memory; its process runs


@dataclass
class _Row:
    """The progress of one run.

    Attributes:
        name: name of the run.
        stage: the current stage; "" between stages and after the end.
        state: state of the current stage, or a text such as "not started", "done in ..." or "failed: ...".
        since: when this state began, in seconds of the monotonic clock.
        finished: the stages that are done.
    """

    name: str
    stage: str = ""
    state: str = "not started"
    since: float = 0.0
    finished: set[str] = field(default_factory=set)


class Progress:
    """A context manager that shows the progress of runs while it is entered.

    The threads of the runs report events by `update` and `end`. Their own output must not go to the terminal.
    """

    def __init__(self, names: list[str], homes: list[Path], stages: list[str], at_once: int, header: str):
        """Prepare the table of progress.

        Args:
            names: name of each run. In `update` and `end`, a run is identified by its index here.
            homes: folder of each run, whose receipts tell how long stages took before.
            stages: all stages, in order.
            at_once: number of runs that run at the same time.
            header: text above the table.
        """
        self._rows = [_Row(name) for name in names]
        self._stages, self._at_once, self._header = stages, at_once, header
        self._seconds: dict[str, list[float]] = {stage: [] for stage in stages}
        for home in homes[:MAX_RECEIPTS]:
            for stage in stages:
                if (found := read_receipt(home / stage)) and "seconds" in found:
                    self._seconds[stage].append(found["seconds"])
        self._live, self._line_count = sys.stdout.isatty(), 0
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._redraw, daemon=True)

    def __enter__(self) -> "Progress":
        say(self._header)
        if self._live:
            self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._ended.set()
        if self._live:
            self._thread.join()
            self._draw()

    def update(self, place: int, stage: str, state: str) -> None:
        """Report the new state of a stage of a run.

        Args:
            place: index of the run.
            state: WAITS, RUNS, or any other text if the stage is done or need not run.
        """
        with self._lock:
            row, now = self._rows[place], time.monotonic()
            if state in (WAITS, RUNS):
                row.stage, row.state, row.since = stage, state, now
            else:
                if row.stage == stage and row.state == RUNS:
                    self._seconds[stage].append(now - row.since)
                row.finished.add(stage)
                row.stage, row.state = "", ""
            seconds = self._seconds_left(row)
        if state == RUNS and not self._live:
            about = "" if seconds is None else f"; {format_seconds(seconds)} left of all its stages"
            print(f"{time.strftime('%H:%M:%S')} {row.name}: {stage}{about}", flush=True)

    def end(self, place: int, error: str | None, seconds: float) -> None:
        """Report the end of a run.

        Args:
            place: index of the run.
            error: message of the error; None if the run succeeded.
            seconds: duration of the run.
        """
        with self._lock:
            row = self._rows[place]
            row.stage, row.state = "", f"failed: {error}" if error else f"done in {format_seconds(seconds)}"
            row.finished = set(self._stages)
            ended = sum(each.finished == set(self._stages) for each in self._rows)
        if not self._live:
            print(f"{time.strftime('%H:%M:%S')} {row.name}: {row.state} ({ended} of {len(self._rows)})", flush=True)

    def table(self, width: int, height: int) -> list[str]:
        """Return the lines of the table, cut to a terminal of `width` columns and `height` lines.

        A line with totals comes first, then the runs in progress, then the runs that failed.
        """
        with self._lock:
            ended = [row for row in self._rows if row.finished == set(self._stages)]
            failed = [row for row in ended if row.state.startswith("failed")]
            busy = [row for row in self._rows if row.stage]
            remaining = [self._seconds_left(row) for row in self._rows if row not in ended]
            known = [seconds for seconds in remaining if seconds is not None]
            about = f", {format_seconds(sum(known) / self._at_once)} left" if len(known) == len(remaining) else ""
            head = f"{len(ended) - len(failed)} of {len(self._rows)} done, {len(failed)} failed{about}"
            width_name = max(map(len, (row.name for row in self._rows)), default=0)
            lines = [f"{row.name:<{width_name}}  {row.stage:<12} {self._describe(row)}" for row in busy]
            lines += [f"{row.name:<{width_name}}  {row.state}" for row in failed]
        visible = lines[: max(1, height - 3)]
        more = [f"and {len(lines) - len(visible)} more"] if len(lines) > len(visible) else []
        return [line[: width - 1] for line in [head, *visible, *more]]

    def _describe(self, row: _Row) -> str:
        """Return as text how long the current stage has run and what is left, or that the stage waits."""
        if row.state == WAITS:
            return "waits for cores or memory"
        seconds, since = self._seconds_left(row), format_seconds(time.monotonic() - row.since)
        return f"for {since}" + ("" if seconds is None else f"; {format_seconds(seconds)} left of all its stages")

    def _seconds_left(self, row: _Row) -> float | None:
        """Estimate the seconds to a run's end from mean stage durations of earlier runs; None if one is unknown."""
        total = 0.0
        for stage in self._stages:
            if stage not in row.finished:
                known = self._seconds[stage]
                if not known:
                    return None
                elapsed = time.monotonic() - row.since if (row.stage, row.state) == (stage, RUNS) else 0.0
                total += max(0.0, sum(known) / len(known) - elapsed)
        return total

    def _redraw(self) -> None:
        """Draw the table every `REDRAW_SECONDS` until the context ends; runs in a thread."""
        while not self._ended.wait(REDRAW_SECONDS):
            self._draw()

    def _draw(self) -> None:
        """Print the table in place of the one before: move the cursor up, clear the lines below, and print."""
        size = shutil.get_terminal_size()
        lines = self.table(size.columns, size.lines)
        up = f"\x1b[{self._line_count}A" if self._line_count else ""
        sys.stdout.write(f"{up}\r\x1b[J" + "".join(f"{line}\n" for line in lines))
        sys.stdout.flush()
        self._line_count = len(lines)
