"""Results of a comparison: compare.json, the artifacts that it names, and the table of all methods."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.io.arrays import load_json
from report.paired_statistics import Difference, confidence_half_width, paired_difference

FULL = "full"
FOLDER_COMPARISON = "compare"  # folder in runs/ of a comparison over a folder of scenes
MAIN = "lpips_vgg_box"  # the score that orders the methods
BOX_SCORES = {
    "lpips_vgg_box": "less",
    "lpips_alex_box": "less",
    "psnr_box": "more",
    "ssim_box": "more",
    "flip_box": "less",
}
OUTSIDE_SCORES = {"psnr_outside": "more", "ssim_outside": "more", "flip_outside": "less"}  # outside the masks
SCORES = BOX_SCORES | OUTSIDE_SCORES
PSNR_CAP = 100.0  # dB, for a view that equals the truth; as in metrics.json
MEASURED = ("consistency", "seconds", "own_seconds", "peak_memory_mb", "gaussians", "scenes")
# Mean difference, and half intervals; see report.paired_statistics.Difference.
DIFFERENCE_COLUMNS = ("minus_full", "interval_views", "interval_scenes")
COLUMNS = (
    "method",
    "state",
    "same_as",
    *SCORES,
    *MEASURED,
    *(f"{metric}_{what}" for metric in SCORES for what in DIFFERENCE_COLUMNS),
)
COLUMNS += tuple(f"{metric}_interval" for metric in SCORES)  # half the 95 % interval of the mean over scenes


@dataclass(frozen=True)
class Run:
    """One method on one scene.

    Attributes:
        state: "done", "failed" or "not run yet".
        error: reason of the failure, in one line.
        folders: stage -> its artifact, for stages that were not left out.
        receipts: stage -> its receipt.json.
        metrics: metrics.json, or empty.
        views: view -> the numbers of its row in per_view.csv.
    """

    method: str
    scene: str
    state: str
    error: str
    folders: dict[str, Path]
    receipts: dict[str, dict[str, Any]]
    metrics: dict[str, Any]
    views: dict[str, dict[str, float]]


@dataclass(frozen=True)
class Comparison:
    """All methods on all scenes.

    Attributes:
        home: runs/<scene>, or runs/compare.
        data: the folder of the scenes, if a whole folder was compared.
        methods: the first is the full one.
        runs: (method, scene) -> run.
        same_as: method -> an earlier method that is the very same job in every scene.
    """

    home: Path
    data: Path | None
    scenes: tuple[str, ...]
    methods: tuple[str, ...]
    runs: dict[tuple[str, str], Run]
    same_as: dict[str, str]

    @property
    def distinct_methods(self) -> list[str]:
        """The methods that are not the same job as an earlier one."""
        return [method for method in self.methods if method not in self.same_as]

    @property
    def name(self) -> str:
        return f"{self.data.name}, {len(self.scenes)} scenes" if self.data else self.home.name

    def finished_runs(self, method: str) -> list[Run]:
        """The method's finished runs."""
        return [run for scene in self.scenes if (run := self.runs[method, scene]).state == "done"]


def load_comparison(home: Path) -> Comparison:
    """Read compare.json of runs/<scene>, or of runs/compare for a folder of scenes, and what it names.

    Raises:
        ValueError: nothing was compared yet.
    """
    path = home / "compare.json"
    if not path.exists():
        what = "data=FOLDER" if home.name == FOLDER_COMPARISON else f"scene={home.name}"
        raise ValueError(f"{path}: no such file; run `make {what} compare` first")
    record = load_json(path)
    runs = {(run["method"], run["scene"]): load_run(run, home.parent) for run in record["runs"]}
    data = Path(record["data"]) if "data" in record else None
    scenes, methods = tuple(record["scenes"]), tuple(record["methods"])
    return Comparison(home, data, scenes, methods, runs, _find_same_jobs(methods, scenes, runs))


def _find_same_jobs(
    methods: tuple[str, ...], scenes: tuple[str, ...], runs: dict[tuple[str, str], Run]
) -> dict[str, str]:
    """Method -> an earlier one whose last stage had the same inputs in every scene."""
    first: dict[tuple[str, ...], str] = {}
    same_as = {}
    for method in methods:
        keys = tuple(runs[method, scene].receipts.get("evaluate", {}).get("key", "") for scene in scenes)
        if all(keys) and first.setdefault(keys, method) != method:
            same_as[method] = first[keys]
    return same_as


def load_run(record: dict[str, Any], runs: Path) -> Run:
    """Load one entry of compare.json; `runs` is the folder that its paths are relative to."""
    folders = {stage: runs / folder for stage, folder in record.get("stages", {}).items() if folder}
    evaluate = folders.get("evaluate", Path())
    metrics = evaluate / "metrics.json"
    return Run(
        record["method"],
        record["scene"],
        record["state"],
        record.get("error", ""),
        folders,
        load_receipts(folders),
        load_json(metrics) if metrics.is_file() else {},
        load_views(evaluate / "per_view.csv"),
    )


def load_receipts(folders: dict[str, Path]) -> dict[str, dict[str, Any]]:
    """Stage -> receipt. A stage that scene.yaml replaces has another stage's folder, which counts only once."""
    paths = {stage: folder / "receipt.json" for stage, folder in folders.items() if folder.name == stage}
    return {stage: load_json(path) for stage, path in paths.items() if path.is_file()}


def load_views(path: Path) -> dict[str, dict[str, float]]:
    """View -> its numbers, without empty cells; the PSNR of a view that equals the truth is `PSNR_CAP`."""
    if not path.is_file():
        return {}
    with open(path, newline="", encoding="utf-8") as file:
        rows = {row.pop("view"): row for row in csv.DictReader(file)}
    numbers = {view: {name: _number(name, text) for name, text in row.items()} for view, row in rows.items()}
    return {view: {k: v for k, v in row.items() if v is not None} for view, row in numbers.items()}


def _number(column: str, text: str | None) -> float | None:
    try:
        value = float(text or "")
    except ValueError:
        return None
    if math.isnan(value):
        return None
    return min(value, PSNR_CAP) if "psnr" in column else value


# ------------------------------------------------------------------------------------------------------- the table


def summarize_methods(comparison: Comparison) -> list[dict[str, Any]]:
    """One dict of `COLUMNS` per method: means over its finished scenes.

    None marks missing values, and all values of a method that is the same job as another. The best in `MAIN` comes
    first; methods without it keep their order.
    """
    table = [_row(comparison, method) for method in comparison.methods]
    table.sort(key=lambda row: (row["same_as"] is not None, row[MAIN] is None, row[MAIN] or 0.0))
    for metric in SCORES:
        differences = differences_to_full(comparison, metric)
        for row in table:
            if difference := differences.get(row["method"]):
                values = (difference.mean, difference.views, difference.scenes)
                row |= {f"{metric}_{what}": value for what, value in zip(DIFFERENCE_COLUMNS, values, strict=True)}
    return table


def _row(comparison: Comparison, method: str) -> dict[str, Any]:
    done = comparison.finished_runs(method)
    states = [comparison.runs[method, scene].state for scene in comparison.scenes]
    row: dict[str, Any] = dict.fromkeys(COLUMNS)
    row |= {"method": method, "scenes": len(done)}
    row["state"] = states[0] if len(set(states)) == 1 else f"{len(done)} of {len(states)} done"
    row["same_as"] = comparison.same_as.get(method)
    if row["same_as"]:
        return row
    for name in SCORES:
        values = [run.metrics.get("mean", {}).get(name) for run in done]
        row |= {name: finite_mean(values), f"{name}_interval": mean_interval(values)}
    row["consistency"] = finite_mean([view_consistency(run) for run in done])
    row["seconds"] = finite_mean([total_seconds(run) for run in done])
    row["own_seconds"] = finite_mean([own_seconds(run, comparison.runs[FULL, run.scene]) for run in done])
    peaks = [receipt["peak_memory_mb"] for run in done for receipt in run.receipts.values()]
    row["peak_memory_mb"] = max(peaks, default=None)
    counts = finite_mean([run.metrics.get("gaussians", {}).get(run.metrics.get("result")) for run in done])
    row["gaussians"] = None if counts is None else round(counts)
    return row


def finite_mean(values: list[float | None]) -> float | None:
    """Mean of the values that are finite numbers; None if there are none."""
    finite = [value for value in values if value is not None and math.isfinite(value)]
    return sum(finite) / len(finite) if finite else None


def mean_interval(values: list[float | None]) -> float | None:
    """Half the 95 % interval of the mean of the values that are finite numbers; None for fewer than two."""
    return confidence_half_width(np.array([value for value in values if value is not None and math.isfinite(value)]))


def total_seconds(run: Run) -> float:
    """Seconds of the whole job, evaluation included."""
    return round(sum(receipt["seconds"] for receipt in run.receipts.values()), 2)


def own_seconds(run: Run, full: Run) -> float | None:
    """Seconds of the stages that a run does not share with the full method; 0 for the full method itself."""
    if full.state != "done":
        return None
    own = [receipt["seconds"] for s, receipt in run.receipts.items() if run.folders[s] != full.folders.get(s)]
    return round(sum(own), 2)


def view_consistency(run: Run) -> float | None:
    """Mean over pairs of neighbouring views, if metrics.json has it."""
    value = (run.metrics.get("consistency") or {}).get("consistency")
    return None if value is None else float(value)


def save_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write the table with all digits; missing values are empty cells."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(COLUMNS), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


# ------------------------------------------------------------------------------------------------ against the full one


def differences_to_full(comparison: Comparison, metric: str) -> dict[str, Difference]:
    """Method -> its difference to the full method in a score, over the views that both have."""
    differences = {}
    for method in comparison.distinct_methods:
        if method == FULL:
            continue
        scenes = []
        for run in comparison.finished_runs(method):
            full = comparison.runs[FULL, run.scene]
            both = [v for v in run.views if metric in run.views[v] and metric in full.views.get(v, {})]
            scenes.append(np.array([run.views[v][metric] - full.views[v][metric] for v in both]))
        if difference := paired_difference(scenes):
            differences[method] = difference
    return differences
