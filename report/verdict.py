"""The judgement on a finished job: is the object gone, how much is made up, and what would help most."""

from __future__ import annotations

import re
from pathlib import Path

from report.job_data import JobFiles

MIN_INVENTION = 0.005  # share of the hole below which nothing counts as invented
TO_PAINT = "to_paint"  # folder of the stage `reference` with the views worth painting
MAX_ADVICE = 2  # most views that are named as worth painting
LEAST_GAIN = 0.05  # share of the hole that a view must add to those before it to be worth painting
RANKED = re.compile(r"^\d+\. (.+?)  (\d+)%(  \(painted\))?$", re.MULTILINE)  # a line of to_paint/ranked.txt


def describe_result(job: JobFiles) -> list[str]:
    """Return the judgement on a job as sentences: is the object gone, what was filled in, and what would help most.

    The list is empty if the job has no result yet, or if nothing was to be removed. While a new run changes the job,
    the numbers on disk are not all of the result; the judgement then says so and has no numbers.
    """
    if "evaluate" not in job.folders or "masks" not in job.folders:
        return []
    if not is_of_one_run(job):
        return ["The pictures below are of the earlier result. The judgement follows when the new run is done."]
    sentences, invention = [describe_removal(job)], measure_invention(job)
    if invention is not None and invention < MIN_INVENTION:
        sentences.append("The photographs show everything that was behind the object.")
    elif invention is not None:
        sentences.append(f"No photograph shows {100 * invention:.0f} % of what was behind it: that part is made up.")
        if view := view_to_paint(job):
            sentences.append(f"To improve it most, paint the view {view}.")
    return sentences


def is_of_one_run(job: JobFiles) -> bool:
    """Return whether the result and the filling were made from the results of stages that are on disk now."""
    return all(
        content is None or job.receipts.get(need, {}).get("output", content) == content
        for stage in ("evaluate", "initialize")
        for need, content in job.receipts.get(stage, {}).get("needs", {}).items()
    )


def give_advice(job: JobFiles) -> list[str]:
    """Return how to make the result better: how to paint each of at most `MAX_ADVICE` views; may be empty."""
    folder = job.folders.get("reference", Path()) / TO_PAINT
    views = [(name, share) for name, share, is_painted in rank_views(job) if share >= LEAST_GAIN and not is_painted]
    return [
        f"The view {view} shows {100 * share:.0f} % of the part that is made up. To decide yourself what is there, "
        f"paint {folder / view}.png in any editor where {view}_mask.png is white, save it in the scene's folder as "
        f"painted/{view}.png, and run again."
        for view, share in views[:MAX_ADVICE]
    ]


def describe_removal(job: JobFiles) -> str:
    """Return whether the object is gone, by the parts of it that the stage `masks` found and left in the scene."""
    remnants = job.facts("masks").get("remnants")
    if remnants is None or not job.receipts["masks"]["params"].get("remnants"):
        return "What the masks cover is removed."
    left = [each for each in remnants if not each["removed"]]
    if not left:
        return "What the masks cover is removed, and no other part of the object was found."
    largest = max(left, key=lambda each: each["share"])
    parts = "1 part of it seems" if len(left) == 1 else f"{len(left)} parts of it seem"
    return f"The object is removed, but {parts} to be left. Look at the view {largest['view']}, and mark it there."


def measure_invention(job: JobFiles) -> float | None:
    """Return the share in [0, 1] of the removed region that no photograph and no picture of the user shows.

    The share is the mean over views; None before the stage `initialize`.
    """
    if "initialize" not in job.folders:
        return None
    origins = job.facts("initialize").get("origins")
    if origins is None:
        return None
    return origins["patches"] + origins["nothing"] + (0.0 if is_reference_given(job) else origins["reference"])


def is_reference_given(job: JobFiles) -> bool:
    """Return whether the user gave a picture of what is behind the object."""
    return bool(job.facts("reference").get("given"))


def rank_views(job: JobFiles) -> list[tuple[str, float, bool]]:
    """Return (view, share of the hole that it adds to the views before it, True if painted), painted ones first.

    The views come from ranked.txt; the best of those that are not painted comes first. Empty without this file.
    """
    path = job.folders.get("reference", Path()) / TO_PAINT / "ranked.txt"
    text = path.read_text(encoding="utf-8") if "reference" in job.folders and path.is_file() else ""
    return [(name, int(share) / 100, bool(painted)) for name, share, painted in RANKED.findall(text)]


def view_to_paint(job: JobFiles) -> str | None:
    """Return the name of the first unpainted view that adds at least `LEAST_GAIN` of the hole; None without one."""
    return next((name for name, share, painted in rank_views(job) if not painted and share >= LEAST_GAIN), None)
