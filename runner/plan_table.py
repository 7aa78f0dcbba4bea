"""A plan for readers: the text that `plan` prints, and `run` before it starts, and the record for pages."""

import os
from collections import Counter
from pathlib import Path
from typing import Any

from runner.durations import expected_seconds, is_timed, total_time
from runner.keys import files_outside, paths_outside
from runner.pipeline import SCENE
from runner.plan import Decision
from runner.resolve import ResolvedJob
from runner.text import format_bytes, format_seconds, join_names


def plan_table(job: ResolvedJob, decisions: dict[str, Decision]) -> str:
    """Format a plan as text.

    It has a line with the profile and the reason for it, a line per stage with status, expected time and reason, the
    notes of the stages, the expected time of all that is to run, the weights to fetch, and the folders outside the
    scene's folder from which files are read.
    """
    lines = [f"{job.home.name} (profile {job.profile}: {job.why})"]
    for stage, decision in decisions.items():
        seconds = expected_seconds(job, stage) if is_timed(job, decision) else None
        time = f"~{format_seconds(seconds)}" if seconds is not None else ""
        lines.append(f"  {decision.status:<9} {stage:<12} {time:>7}  {decision.reason}".rstrip())
        lines += [f"{'':33}{note}" for note in decision.notes]
    if total := total_time(job, decisions):
        lines.append(f"  together about {total}" + (f"; GPU: {job.gpu}" if job.gpu else ""))
    rest = dict.fromkeys(line for decision in decisions.values() for line in decision.lacks[1:])
    lines += [f"  besides, {line}" for line in rest]
    needs = {need["name"]: need for decision in decisions.values() for need in decision.needed if need["problem"]}
    if sizes := [need["bytes"] or 0 for need in needs.values() if need["fetched"] and not need["optional"]]:
        lines.append(f"  weights to fetch: {format_bytes(sum(sizes))}, by `make weights profile={job.profile}`")
    if paths := _paths_outside_scene(job, list(decisions)):
        folders = Counter(str(path if path.is_dir() else path.parent) for path in paths)
        named = [f"{path} ({count} file{'s' * (count > 1)})" for path, count in folders.items()]
        lines.append(f"  read outside the scene's folder: {join_names(named)}")
    return "\n".join(lines)


def _paths_outside_scene(job: ResolvedJob, stages: list[str]) -> list[Path]:
    """Return the paths outside the scene's folder that stages read, sorted; scene.yaml or capture files name them."""
    readers = [stage for stage in stages if stage in job.stages and SCENE in job.pipeline.stages[stage].all_needs]
    reads = [path for stage in readers for path in files_outside(job.stages[stage].reads or (), job.folder)]
    named = [
        path
        for stage in readers
        if job.stages[stage].reads is None
        for path in paths_outside(job.params[stage], job.folder)
    ]
    return sorted({*reads, *named})


def plan_record(job: ResolvedJob, decisions: dict[str, Decision], unset: ResolvedJob) -> dict[str, Any]:
    """Return the content of plan.json, which the report reads.

    Args:
        job: the job.
        decisions: the plan, stage -> decision.
        unset: the same job without `set=` and `budget=`, whose parameters are recorded.

    Returns:
        "profile": its name; "stages": stage -> {"word": status, "reason", "notes", "folder": relative to runs/, or
        None, "seconds": see `expected_seconds`}; "params": stage -> all parameters of `unset`.
    """
    folder = lambda path: path and os.path.relpath(path, job.runs)
    entry = lambda d: {"word": d.status, "reason": d.reason, "notes": list(d.notes), "folder": folder(d.path)}
    stages = {stage: entry(d) | {"seconds": expected_seconds(job, stage)} for stage, d in decisions.items()}
    return {"profile": job.profile, "stages": stages, "params": unset.params}
