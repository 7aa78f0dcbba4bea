"""How far many runs are: a table that is drawn anew on a terminal, a line for each event elsewhere."""

import shutil
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from runner import say
from runner.files import read_receipt

LOOKED_AT = 50  # runs whose receipts tell what a stage takes, at most
EVERY = 1.0  # seconds between drawings
WAITS, RUNS = "waits", "runs"  # for its cores and memory; for its end


@dataclass
class _Row:
    """One run: the stage it is at since when (monotonic seconds), stages that are behind it, its end."""

    name: str
    stage: str = ""
    state: str = "not begun"
    since: float = 0.0
    behind: set[str] = field(default_factory=set)


class Progress:
    """A context; other threads, whose own words go elsewhere, tell it what happens."""

    def __init__(self, names: list[str], homes: list[Path], stages: list[str], at_once: int, said: str):
        """said: what stands above the table."""
        self._rows = [_Row(name) for name in names]
        self._stages, self._at_once, self._said = stages, at_once, said
        self._seconds: dict[str, list[float]] = {stage: [] for stage in stages}
        for home in homes[:LOOKED_AT]:
            for stage in stages:
                if (found := read_receipt(home / stage)) and "seconds" in found:
                    self._seconds[stage].append(found["seconds"])
        self._live, self._drawn = sys.stdout.isatty(), 0
        self._lock, self._over = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._draw_on, daemon=True)

    def __enter__(self) -> "Progress":
        say(self._said)
        if self._live:
            self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._over.set()
        if self._live:
            self._thread.join()
            self._draw()

    def stage(self, place: int, stage: str, word: str) -> None:
        """A run's stage waits, runs, or is done with (or needs not be)."""
        with self._lock:
            row, now = self._rows[place], time.monotonic()
            if word in (WAITS, RUNS):
                row.stage, row.state, row.since = stage, word, now
            else:
                if row.stage == stage and row.state == RUNS:
                    self._seconds[stage].append(now - row.since)
                row.behind.add(stage)
                row.stage, row.state = "", ""
            left = self._left(row)
        if word == RUNS and not self._live:
            about = "" if left is None else f"; {_short(left)} left of all its stages"
            print(f"{time.strftime('%H:%M:%S')} {row.name}: {stage}{about}", flush=True)

    def ended(self, place: int, error: str | None, seconds: float) -> None:
        with self._lock:
            row = self._rows[place]
            row.stage, row.state = "", f"failed: {error}" if error else f"done in {_short(seconds)}"
            row.behind = set(self._stages)
            over = sum(each.behind == set(self._stages) for each in self._rows)
        if not self._live:
            print(f"{time.strftime('%H:%M:%S')} {row.name}: {row.state} ({over} of {len(self._rows)})", flush=True)

    def table(self, width: int, height: int) -> list[str]:
        """The lines of the table as it is now, cut to a terminal's size: what runs first, then what failed."""
        with self._lock:
            over = [row for row in self._rows if row.behind == set(self._stages)]
            failed = [row for row in over if row.state.startswith("failed")]
            busy = [row for row in self._rows if row.stage]
            lefts = [self._left(row) for row in self._rows if row not in over]
            about = "" if None in lefts else f", {_short(sum(map(float, lefts)) / self._at_once)} left"
            head = f"{len(over) - len(failed)} of {len(self._rows)} done, {len(failed)} failed{about}"
            wide = max(map(len, (row.name for row in self._rows)), default=0)
            lines = [f"{row.name:<{wide}}  {row.stage:<12} {self._words(row)}" for row in busy]
            lines += [f"{row.name:<{wide}}  {row.state}" for row in failed]
        shown = lines[: max(1, height - 3)]
        more = [f"and {len(lines) - len(shown)} more"] if len(lines) > len(shown) else []
        return [line[: width - 1] for line in [head, *shown, *more]]

    def _words(self, row: _Row) -> str:
        if row.state == WAITS:
            return "waits for cores or memory"
        left, since = self._left(row), _short(time.monotonic() - row.since)
        return f"for {since}" + ("" if left is None else f"; {_short(left)} left of all its stages")

    def _left(self, row: _Row) -> float | None:
        """Seconds to the end of a run, by what its stages took before, here or in other scenes; None: not known."""
        total = 0.0
        for stage in self._stages:
            if stage not in row.behind:
                known = self._seconds[stage]
                if not known:
                    return None
                gone = time.monotonic() - row.since if (row.stage, row.state) == (stage, RUNS) else 0.0
                total += max(0.0, sum(known) / len(known) - gone)
        return total

    def _draw_on(self) -> None:
        while not self._over.wait(EVERY):
            self._draw()

    def _draw(self) -> None:
        """Over what was drawn before: the cursor goes up, and all below it is cleared."""
        size = shutil.get_terminal_size()
        lines = self.table(size.columns, size.lines)
        up = f"\x1b[{self._drawn}A" if self._drawn else ""
        sys.stdout.write(f"{up}\r\x1b[J" + "".join(f"{line}\n" for line in lines))
        sys.stdout.flush()
        self._drawn = len(lines)


def _short(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
