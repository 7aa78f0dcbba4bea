"""Every scene of a folder, and one table; where results are, in words."""

from __future__ import annotations

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from runner import Failed, Refused, say
from runner.execute import run_scene
from runner.files import RECEIPT, shown
from runner.resolve import Memory, Request


def _mean(evaluate: Path | None, of: str = "mean") -> dict[str, float | None]:
    return json.loads((evaluate / "metrics.json").read_text()).get(of, {}) if evaluate else {}


def show_results(stage: str, folder: Path | None) -> None:
    """Where the results are; after `evaluate` the mean metrics too, those of the initialization beside them."""
    if folder is None:
        return
    if stage == "evaluate":
        initial = _mean(folder, "initialize")
        for name, value in _mean(folder).items():
            before = _number(initial.get(name))
            say(
                f"  {name:<16} {_number(value) or 'not available':<14}"
                + (f" initialization {before}" if before else "")
            )
    names = (p.name + ("/" if p.is_dir() else "") for p in sorted(folder.iterdir()) if p.name != RECEIPT)
    say(f"results in {shown(folder)}/: {', '.join(names)}")


def _number(value: Any) -> str:
    return f"{value:.4f}" if isinstance(value, float) else "" if value is None else str(value)


def batch(request: Request, folder: Path) -> int:
    """Every scene in `folder`, one after another; a table in runs/results.{csv,md}. Returns how many failed."""
    scenes = sorted(p for p in folder.iterdir() if p.is_dir() and p.name[0] not in "._") if folder.is_dir() else []
    if not scenes:
        raise Refused(f"data={folder}: no folders of scenes there")
    rows: dict[str, dict[str, float | None]] = {}
    failed: dict[str, str] = {}
    memory = Memory(request.runs)
    for scene in scenes:
        try:
            rows[scene.name] = _mean(run_scene(replace(request, scene=str(scene)), "all", memory).get("evaluate"))
        except (Refused, Failed) as error:
            failed[scene.name] = str(error)
            print(f"error: {error}", file=sys.stderr, flush=True)
    suffix = f"@{request.variant}" if request.variant else ""
    _write_table(request.runs / f"results{suffix}", rows, failed)
    for name, reason in failed.items():
        say(f"failed: {name}: {reason}")
    say(f"{len(rows)} of {len(scenes)} scenes done; table: {shown(request.runs)}/results{suffix}.csv and .md")
    return len(failed)


def _write_table(stem: Path, rows: dict[str, dict[str, float | None]], failed: dict[str, str]) -> None:
    """A row a scene, and the mean over the scenes that have a value."""
    names = list(dict.fromkeys(name for row in rows.values() for name in row))
    lines = [[scene, "done", *(_number(row.get(name)) for name in names)] for scene, row in rows.items()]
    lines += [[scene, "failed", *("" for _ in names)] for scene in failed]
    means = []
    for name in names:
        values = [row[name] for row in rows.values() if isinstance(row.get(name), int | float)]
        means.append(_number(sum(values) / len(values)) if values else "")  # type: ignore[arg-type]
    lines.append([f"mean of {len(rows)}", "", *means])
    header = ["scene", "state", *names]
    stem.parent.mkdir(parents=True, exist_ok=True)
    with open(f"{stem}.csv", "w", newline="") as file:
        csv.writer(file).writerows([header, *lines])
    text = [" | ".join(cells) for cells in (header, ["---"] * len(header), *lines)]
    Path(f"{stem}.md").write_text("".join(f"| {line} |\n" for line in text))
