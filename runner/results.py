"""Printing of a run's scores, and the record of a plan for report/."""

import os
from pathlib import Path
from typing import Any

from reffusion.command import is_installed, workplace
from runner import say
from runner.durations import expected_seconds
from runner.files import RECEIPT, read_json
from runner.plan import Decision
from runner.resolve import Request, ResolvedJob
from runner.text import display_path

SCENE_FILE = "scene.ply"  # file with the result in the artifact of the stage `evaluate`


def mean_scores(evaluate: Path | None, key: str = "mean") -> dict[str, float | None]:
    """Read the mean scores from an artifact of the stage `evaluate`.

    Args:
        evaluate: folder of the artifact; None if the stage was skipped.
        key: "mean" for the scores of the result, "initialize" for those of the initialization.

    Returns:
        Name of the score -> mean over the views, None where no view has this score; empty without an artifact.
    """
    return (read_json(evaluate / "metrics.json") or {}).get(key, {}) if evaluate else {}


def show_results(stage: str, folder: Path | None, request: Request) -> None:
    """Print the folder and the files of a stage's result.

    For `evaluate`, also print the mean scores and the commands that open the scene and the report. A skipped stage,
    whose folder is None, prints nothing.
    """
    if folder is None:
        return
    if stage == "evaluate":
        initial, scores = mean_scores(folder, "initialize"), mean_scores(folder)
        scores = {name: value for name, value in scores.items() if value is not None}
        for name, value in scores.items():
            before = f" initialization {_format_score(initial[name])}" if initial.get(name) is not None else ""
            say(f"  {name:<16} {_format_score(value):<14}{before}")
        if not scores:
            say("  no scores: no test view shows the scene without the object (`test` in scene.yaml)")
    names = (p.name + ("/" if p.is_dir() else "") for p in sorted(folder.iterdir()) if p.name != RECEIPT)
    say(f"results in {display_path(folder)}/: {', '.join(names)}")
    if stage == "evaluate" and (folder / SCENE_FILE).is_file():
        say(f"open {display_path(folder / SCENE_FILE)} in any viewer of 3D Gaussian splats, or here:")
        say(f"  {format_command(request, 'view')}    {format_command(request, 'report')}")


def format_command(request: Request, command: str) -> str:
    """Return the command line that runs another command on the scene and results of `request`.

    In a checkout it is a `make` command, which also installs what the command needs. For an installed package it is a
    `reffusion` command.
    """
    runs = "" if request.runs == workplace(request.root) / "runs" else display_path(request.runs)
    options = {"scene": request.scene, "variant": request.variant, "runs": runs}
    if is_installed(request.root):
        return f"reffusion {command} " + " ".join(f"--{name} {value}" for name, value in options.items() if value)
    return "make " + " ".join(f"{name}={value}" for name, value in options.items() if value) + f" {command}"


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


def _format_score(value: Any) -> str:
    """Return a score as text, a float with four decimals."""
    return f"{value:.4f}" if isinstance(value, float) else str(value)
