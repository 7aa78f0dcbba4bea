"""Progress of a job, read from its logs: the stage that runs, the share done, and the seconds left."""

from __future__ import annotations

import json
import re
import time
from dataclasses import dataclass
from pathlib import Path

# A progress bar: its label, steps done, all steps, and the time left.
BAR = re.compile(r"(\w+):\s+\d+%\|[^|]*\|\s*(\d+)/(\d+) \[[^<\]]*<([\d:]+)")
# The shown time left is corrected if an estimate differs by more than this share of it, and by more seconds than this.
STEADY_SHARE, STEADY_SECONDS = 0.25, 15.0
OVERDUE_SHARE = 0.1  # a stage that takes longer than expected is expected to take this share of its time longer


def find_running_stage(home: Path, began: float) -> tuple[str, float]:
    """Return the stage that runs in a scene's folder, and the time at which it began; ("", 0) between stages.

    A stage opens <stage>.log when it begins, and its last line there is the result. Times are in seconds since 1970.

    Args:
        began: time at which the runner began; older log files are not considered.
    """
    latest = max(home.glob("*.log"), key=lambda path: path.stat().st_mtime, default=None)
    if latest is None or latest.stat().st_mtime < began - 1:
        return "", 0.0
    lines = latest.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    try:
        ended = "seconds" in json.loads(lines[-1][20:])
        since = time.mktime(time.strptime(lines[0][:19], "%Y-%m-%d %H:%M:%S"))
    except (IndexError, ValueError, TypeError):  # nothing is written yet
        ended, since = False, latest.stat().st_mtime
    return ("", 0.0) if ended else (latest.stem, since)


def estimate_remaining(
    elapsed: float, expected: float | None, bar: tuple[float, float] | None
) -> tuple[float | None, float | None]:
    """Return the share of a stage's seconds that is over and the seconds left; (None, None) if both are unknown.

    The further a progress bar is, the more the seconds that it predicts count, because first steps tell little.

    Args:
        elapsed: seconds since the stage began.
        expected: its expected seconds; None or 0 if they are unknown.
        bar: share done and seconds left of its progress bar; None without one.
    """
    if bar and not expected:
        return bar
    if not expected:
        return None, None
    left = max(expected - elapsed, OVERDUE_SHARE * elapsed)
    if bar:
        left = (1 - bar[0]) ** 2 * expected + bar[0] * bar[1]
    return elapsed / (elapsed + left), left


@dataclass
class ShownProgress:
    """The numbers that the page shows of a job: bars never run back, and the time left counts down.

    Estimates change at every look. A new one replaces the shown end only if it differs much.

    Attributes:
        began: time at which the job began.
        stage: the stage that runs.
        share: share of the stage that is shown.
        whole: share of the job that is shown.
        end: time at which the job ends, as shown; None if it is unknown.
    """

    began: float
    stage: str = ""
    share: float = 0.0
    whole: float = 0.0
    end: float | None = None

    def update(self, now: float, stage: str, share: float | None, left: float | None) -> dict[str, float | None]:
        """Take in new estimates, and return what to show as {"share", "left", "whole"}, each None if it is unknown.

        Args:
            now: the time.
            stage: the stage that runs.
            share: share of the stage that is estimated to be done.
            left: estimated seconds to the end of the job.
        """
        if stage != self.stage:
            self.stage, self.share = stage, 0.0
        if left is None:
            self.end = None
        else:
            shown = self.end - now if self.end is not None else 0.0
            if abs(left - shown) > max(STEADY_SHARE * left, STEADY_SECONDS) or shown <= 0:
                self.end = now + left
            elapsed = max(now - self.began, 0.0)
            self.whole = max(self.whole, elapsed / (elapsed + left) if elapsed + left else 0.0)
        self.share = max(self.share, share or 0.0)
        return {
            "share": None if share is None else self.share,
            "left": None if self.end is None else self.end - now,
            "whole": None if left is None else self.whole,
        }


def find_bar(lines: list[str], stage: str) -> tuple[float, float] | None:
    """Return the share done and the seconds left of a stage's bar in the last 3 lines of a log; None without one."""
    bars = [bar for line in lines[-3:] for bar in BAR.findall(line) if bar[0] == stage and int(bar[2])]
    return (int(bars[-1][1]) / int(bars[-1][2]), _read_clock(bars[-1][3])) if bars else None


def _read_clock(text: str) -> float:
    """Return the seconds of a duration such as 1:02:03 or 02:03."""
    seconds = 0.0
    for part in text.split(":"):
        seconds = 60 * seconds + float(part or 0)
    return seconds
