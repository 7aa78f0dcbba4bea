"""Progress of a job, read from its logs: the stage that runs, the share done, and the seconds left."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

# A progress bar: its label, steps done, all steps, and the time left.
BAR = re.compile(r"(\w+):\s+\d+%\|[^|]*\|\s*(\d+)/(\d+) \[[^<\]]*<([\d:]+)")
OVERDUE_SHARE = 0.1  # a stage that takes longer than expected is expected to take this share of its time longer


def find_running_stage(home: Path, began: float) -> tuple[str, float]:
    """Return the stage that runs in a scene's folder, and the time at which it began; ("", 0) between stages.

    A stage opens <stage>.log when it begins, and its last line there is the result.

    Args:
        began: time at which the runner began.
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

    The seconds that a progress bar predicts count the more the further it is: first steps tell little.

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


def find_bar(lines: list[str], stage: str) -> tuple[float, float] | None:
    """Return the share done and the seconds left of a stage's progress bar in the last lines of a log."""
    bars = [bar for line in lines[-3:] for bar in BAR.findall(line) if bar[0] == stage and int(bar[2])]
    return (int(bars[-1][1]) / int(bars[-1][2]), _read_clock(bars[-1][3])) if bars else None


def _read_clock(text: str) -> float:
    """Return the seconds of a duration such as 1:02:03 or 02:03."""
    seconds = 0.0
    for part in text.split(":"):
        seconds = 60 * seconds + float(part or 0)
    return seconds
