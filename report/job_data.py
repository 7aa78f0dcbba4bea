"""Files of a scene's job: its plan, artifacts, receipts, traces and scores."""

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
    """A scene's job as it lies on the disk.

    Attributes:
        home: runs/<scene>, or runs/<scene>@<variant>.
        plan: stage -> word, reason, notes, as the runner wrote them to plan.json; may be empty, see `load_plan`.
        unset: stage -> all its parameters without the command line's `set=` and `budget=`; may be empty.
        folders: stage -> its artifact, in order; a variant shares artifacts with the scene's own run.
        receipts: stage -> receipt.json.
        traces: stage -> series -> lines.
        unread: reasons why traces could not be read.
        metrics: metrics.json, or empty.
    """

    home: Path
    plan: dict[str, dict[str, Any]]
    unset: dict[str, dict[str, Any]]
    folders: dict[str, Path]
    receipts: dict[str, dict[str, Any]]
    traces: dict[str, dict[str, trace_charts.Lines]]
    unread: tuple[str, ...]
    metrics: dict[str, Any]


def load_job(home: Path) -> JobFiles:
    """Load a job; ValueError if no stage has been done."""
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
    """Stages of plan.json; empty if there is none, or a stage was done after it was written."""
    path = home / "plan.json"
    if not path.exists() or any(r.stat().st_mtime > path.stat().st_mtime for r in home.glob("*/receipt.json")):
        return {}
    return load_json(path)["stages"]
