"""What lies on the disk for a scene's job."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reffusion.io.arrays import load_json
from reffusion.io.traces import load_trace
from report import curves, sheet
from report.results import load_receipts

ORDER = (
    "poses", "raw_masks", "fit", "masks", "reference", "lift", "initialize", "personalize", "distill", "finish",
    "evaluate",
)  # fmt: skip


@dataclass(frozen=True)
class Job:
    """What lies on the disk for a scene.

    Attributes:
        home: runs/<scene>, or runs/<scene>@<variant>.
        plan: stage -> word, reason, notes, as the runner wrote them to plan.json; or empty, see `load_plan`.
        unset: stage -> all its parameters as they are without `set=` and `budget=`; or empty.
        folders: stage -> its artifact, in order; a variant's may lie with the scene's own run.
        receipts: stage -> receipt.json.
        traces: stage -> series -> lines.
        unread: why a trace could not be read, in words.
        metrics: metrics.json, or empty.
    """

    home: Path
    plan: dict[str, dict[str, Any]]
    unset: dict[str, dict[str, Any]]
    folders: dict[str, Path]
    receipts: dict[str, dict[str, Any]]
    traces: dict[str, dict[str, curves.Lines]]
    unread: tuple[str, ...]
    metrics: dict[str, Any]


def load_job(home: Path) -> Job:
    """Raises ValueError where no stage has been done."""
    plan = load_plan(home)
    names = list(plan or ORDER)
    places = {s: home.parent / plan[s]["folder"] if plan and plan[s]["folder"] else None for s in plan}
    found = {stage: places.get(stage) or sheet.stage_folder(home, stage) for stage in names}
    left_out = {stage for stage, said in plan.items() if said["word"] == "skip"}
    folders = {s: f for s, f in found.items() if s not in left_out and (f / "receipt.json").exists()}
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
    return Job(home, plan, unset, folders, load_receipts(folders), traces, tuple(unread), scores)


def load_plan(home: Path) -> dict[str, dict[str, Any]]:
    """plan.json's stages; empty where there is none, or a stage was done after it was written."""
    path = home / "plan.json"
    if not path.exists() or any(r.stat().st_mtime > path.stat().st_mtime for r in home.glob("*/receipt.json")):
        return {}
    return load_json(path)["stages"]
