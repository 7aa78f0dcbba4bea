"""One sentence of judgement on a finished job: is the object gone, how much is made up, and what would help most."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from reffusion.io.arrays import load_json
from report.job_data import JobFiles

MIN_INVENTION = 0.005  # share of the hole below which nothing counts as invented
TO_PAINT = "to_paint"  # folder of the stage `reference` with the views worth painting
MAX_ADVICE = 2  # most views that are named as worth painting
LEAST_GAIN = 0.05  # share of the hole that a view must show to be worth painting
RANKED = re.compile(r"^\d+\. (.+?)  (\d+)%(  \(painted\))?$", re.MULTILINE)  # a line of to_paint/ranked.txt


def describe_result(job: JobFiles) -> str:
    """Return the judgement on a job, e.g. "... 10 % of what it hid is made up; a completed picture of a would help
    most.".

    The text is empty if the job has no result yet, or if nothing was to be removed.
    """
    if "evaluate" not in job.folders or "masks" not in job.folders:
        return ""
    parts, invention = [describe_removal(job)], measure_invention(job)
    if invention is not None and invention < MIN_INVENTION:
        parts.append("the photographs show all that it hid")
    elif invention is not None:
        parts.append(f"{invention:.0%} of what it hid is made up".replace("%", " %"))
        if view := view_to_paint(job):
            parts.append(f"a completed picture of {view} would help most")
    return "; ".join(parts) + "."


def give_advice(job: JobFiles) -> list[str]:
    """Return how to make the result better: at most `MAX_ADVICE` views to paint, one sentence each."""
    folder = job.folders.get("reference", Path()) / TO_PAINT
    views = [(name, share) for name, share, is_painted in rank_views(job) if share >= LEAST_GAIN and not is_painted]
    return [
        f"{view} shows {share:.0%} of what is made up. To decide it yourself, complete {folder / view}.png in any "
        f"editor where {view}_mask.png is white, save it in the scene's folder as painted/{view}.png, and run again."
        for view, share in views[:MAX_ADVICE]
    ]


def describe_removal(job: JobFiles) -> str:
    """Return whether the object is gone, by the parts of it that the stage `masks` found and left in the scene."""
    remnants = _facts(job, "masks").get("remnants")
    if remnants is None or not job.receipts["masks"]["params"].get("remnants"):
        return "The object is removed, as far as the masks show it"
    left = [each for each in remnants if not each["removed"]]
    if not left:
        return "What the masks show is removed; look whether they left out a part of the object"
    largest = max(left, key=lambda each: each["share"])
    parts = "a part" if len(left) == 1 else f"{len(left)} parts"
    return f"Most of the object is removed, but {parts} may be left (best seen in {largest['view']}; correct the masks)"


def measure_invention(job: JobFiles) -> float | None:
    """Return the share in [0, 1] of the removed region that no photograph and no picture of the user shows.

    It is the mean over views; None before the stage `initialize`.
    """
    if "initialize" not in job.folders:
        return None
    origins = _facts(job, "initialize").get("origins")
    if origins is None:
        return None
    is_given = bool(_facts(job, "reference").get("given"))
    return origins["patches"] + origins["nothing"] + (0.0 if is_given else origins["reference"])


def rank_views(job: JobFiles) -> list[tuple[str, float, bool]]:
    """Return the views worth painting as (name, share of the hole that it shows, True if painted), the best first."""
    path = job.folders.get("reference", Path()) / TO_PAINT / "ranked.txt"
    text = path.read_text(encoding="utf-8") if "reference" in job.folders and path.is_file() else ""
    return [(name, int(share) / 100, bool(painted)) for name, share, painted in RANKED.findall(text)]


def view_to_paint(job: JobFiles) -> str | None:
    """Return the name of the view whose painting would help most; None if none would help much."""
    return next((name for name, share, painted in rank_views(job) if not painted and share >= LEAST_GAIN), None)


def _facts(job: JobFiles, stage: str) -> dict[str, Any]:
    path = job.folders.get(stage, Path()) / "facts.json"
    return load_json(path) if stage in job.folders and path.is_file() else {}
