"""Files of a scene's job: the plan, and the stages' folders, receipts, traces and scores.

A *job* is all stages of one scene, or of one variant of a scene. A *receipt* (receipt.json) records a stage's inputs,
parameters, seconds and memory. A *trace* (trace.jsonl) records a stage's errors over time.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reffusion.io.arrays import load_json
from reffusion.io.traces import load_trace
from report import sheet, trace_charts
from report.results import load_receipts

STAGES = (
    "poses", "raw_masks", "fit", "masks", "reference", "lift", "initialize", "personalize", "distill", "finish",
    "evaluate",
)  # fmt: skip


@dataclass(frozen=True)
class JobFiles:
    """Files of a job, as loaded from the disk.

    Attributes:
        home: runs/<scene>, or runs/<scene>@<variant>.
        plan: stage -> {"word": status such as "cached", "skip" or "run", "reason": text, "notes": texts, "folder": the
            stage's folder relative to the folder of all runs, or empty}, from plan.json; may be empty, see `load_plan`.
        unset: stage -> all parameters as they would be without `set=` and `budget=` on the command line; empty if no
            plan was recorded.
        folders: stage -> folder that the stage wrote, in the order of the stages, for stages that are done and not
            skipped. A variant shares folders with the scene's own run.
        receipts: stage -> content of receipt.json, for the stages in `folders`, except those that scene.yaml replaces
            by another stage's result.
        traces: stage -> series ("" for the one without a name) -> lines of the trace, for stages with a readable trace,
            with the same exception.
        unread: reasons why traces could not be read, one per trace.
        metrics: content of metrics.json; empty if the job is not evaluated.
    """

    home: Path
    plan: dict[str, dict[str, Any]]
    unset: dict[str, dict[str, Any]]
    folders: dict[str, Path]
    receipts: dict[str, dict[str, Any]]
    traces: dict[str, dict[str, trace_charts.Lines]]
    unread: tuple[str, ...]
    metrics: dict[str, Any]

    def facts(self, stage: str) -> dict[str, Any]:
        """Return the facts.json of a stage; {} if the stage is not done or has none."""
        path = self.folders.get(stage, Path()) / "facts.json"
        return load_json(path) if stage in self.folders and path.is_file() else {}


def load_job(home: Path) -> JobFiles:
    """Load the job in runs/<scene> or runs/<scene>@<variant>.

    Raises:
        ValueError: no stage has been done.
    """
    plan = load_plan(home)
    names = list(plan or STAGES)
    planned = {s: home.parent / plan[s]["folder"] if plan and plan[s]["folder"] else None for s in plan}
    stage_folders = {stage: planned.get(stage) or sheet.stage_folder(home, stage) for stage in names}
    skipped = {stage for stage, entry in plan.items() if entry["word"] == "skip"}
    folders = {s: f for s, f in stage_folders.items() if s not in skipped and (f / "receipt.json").exists()}
    if not folders:
        raise ValueError(f"{home}: no stage has been done; run `make scene={home.name} all` first")
    traces, unread = {}, []
    for stage, folder in folders.items():
        if folder.name == stage and (folder / "trace.jsonl").exists():
            try:
                traces[stage] = load_trace(folder / "trace.jsonl", stage)
            except ValueError as error:
                unread.append(str(error))
    metrics = folders.get("evaluate", Path()) / "metrics.json"
    scores = load_json(metrics) if metrics.is_file() else {}
    record = home / "plan.json"
    unset = load_json(record).get("params", {}) if record.exists() else {}
    return JobFiles(home, plan, unset, folders, load_receipts(folders), traces, tuple(unread), scores)


def load_plan(home: Path) -> dict[str, dict[str, Any]]:
    """Load the stages of plan.json, see `JobFiles.plan`.

    The result is empty if there is no plan.json, or if a stage was done later and plan.json is therefore out of date.
    """
    path = home / "plan.json"
    if not path.exists() or any(r.stat().st_mtime > path.stat().st_mtime for r in home.glob("*/receipt.json")):
        return {}
    return load_json(path)["stages"]
