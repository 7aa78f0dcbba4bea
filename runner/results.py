"""Prints the scores of a run, and calls report/ for tables and pages."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from reffusion.command import is_installed, workplace
from runner import Failed, say
from runner.files import RECEIPT, read_json
from runner.process import PROJECT
from runner.resolve import Request
from runner.text import display_path

SCENE_FILE = "scene.ply"  # of the stage `evaluate`


def mean_scores(evaluate: Path | None, key: str = "mean") -> dict[str, float | None]:
    """The mean scores in an artifact of `evaluate`; with `key="initialize"` those of the initialization."""
    return (read_json(evaluate / "metrics.json") or {}).get(key, {}) if evaluate else {}


def show_results(stage: str, folder: Path | None, request: Request) -> None:
    """Print where the results of a stage are; after `evaluate` also the mean scores and the commands to open them."""
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
    """What to type for another command on the same scene and results: `make` in a checkout, where it also installs what
    the command needs, else `reffusion`."""
    runs = "" if request.runs == workplace(request.root) / "runs" else display_path(request.runs)
    options = {"scene": request.scene, "variant": request.variant, "runs": runs}
    if is_installed(request.root):
        return f"reffusion {command} " + " ".join(f"--{name} {value}" for name, value in options.items() if value)
    return "make " + " ".join(f"{name}={value}" for name, value in options.items() if value) + f" {command}"


def write_table(record: Path) -> None:
    """Let report/table.py write the table of a batch or a comparison beside its record."""
    if call_report("table", str(record)):
        raise Failed(f"the table of {display_path(record)} could not be written (see above)")


def call_report(module: str, *arguments: str) -> int:
    """Run `python -m report.<module>`; its exit code."""
    path = os.pathsep.join(filter(None, [str(PROJECT), os.environ.get("PYTHONPATH", "")]))
    command = [sys.executable, "-m", f"report.{module}", *arguments]
    return subprocess.run(command, env={**os.environ, "PYTHONPATH": path}).returncode


def _format_score(value: Any) -> str:
    return f"{value:.4f}" if isinstance(value, float) else str(value)
