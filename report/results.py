"""Results of a comparison: its record compare.json, the results of its runs, and the table of all methods.

A comparison runs the full method and its variants, here called *methods*, on one scene or on all scenes of a folder.
A *run* is one method on one scene. Scores named `*_box` are measured in the bounding box of a view's mask, 10% wider on
each side; scores named `*_outside` are measured outside the masks.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.io.arrays import load_json
from reffusion.io.scene import has_object_mask
from report.paired_statistics import Difference, confidence_half_width, paired_difference

FULL = "full"
START = "start of full"  # row of the full method's initialization: what distillation begins with
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
PSNR_CAP = 100.0  # dB, instead of infinity for a view that equals the ground truth; as in metrics.json
MEASURED = ("consistency", "seconds", "own_seconds", "peak_memory_mb", "gaussians", "scenes")
# Endings of column names: the mean difference, and half the widths of its intervals; see
# report.paired_statistics.Difference.
DIFFERENCE_COLUMNS = ("minus_full", "interval_views", "interval_scenes")
COLUMNS = (
    "method",
    "state",
    "same_as",
    "stand_ins",
    *SCORES,
    *MEASURED,
    *(f"{metric}_{what}" for metric in SCORES for what in DIFFERENCE_COLUMNS),
)
COLUMNS += tuple(f"{metric}_interval" for metric in SCORES)  # half the 95 % interval of the mean over scenes


@dataclass(frozen=True)
class Run:
    """Run of one method on one scene.

    Attributes:
        method: name of the method.
        scene: name of the scene.
        state: "done", "failed" or "not run yet".
        error: reason of the failure, in one line; empty if the run did not fail.
        folders: stage -> folder that the stage wrote, for stages that were not skipped; empty if the run is not done.
            Methods share folders of stages in which they do not differ.
        receipts: stage -> content of the stage's receipt.json, see `load_receipts`.
        metrics: content of metrics.json; empty if the run is not evaluated.
        views: view -> the numbers of the view's row in per_view.csv.
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
    """Runs of all methods on all scenes.

    Attributes:
        home: folder of the comparison: runs/<scene>, or runs/compare for a folder of scenes.
        data: folder of the scenes, or None if a single scene was compared.
        scenes: names of the scenes.
        methods: names of the methods; the first one is the full method.
        runs: (method, scene) -> run.
        same_as: method -> an earlier method that computes exactly the same in every scene. The method is then called a
            duplicate.
    """

    home: Path
    data: Path | None
    scenes: tuple[str, ...]
    methods: tuple[str, ...]
    runs: dict[tuple[str, str], Run]
    same_as: dict[str, str]

    @property
    def distinct_methods(self) -> list[str]:
        """Names of the methods, without duplicates (methods that compute exactly the same as an earlier method)."""
        return [method for method in self.methods if method not in self.same_as]

    @property
    def name(self) -> str:
        """Title of the comparison: the scene's name, or the folder's name and the number of scenes."""
        return f"{self.data.name}, {len(self.scenes)} scenes" if self.data else self.home.name

    def finished_runs(self, method: str) -> list[Run]:
        """Return a method's finished runs, in the order of the scenes."""
        return [run for scene in self.scenes if (run := self.runs[method, scene]).state == "done"]


def load_comparison(home: Path) -> Comparison:
    """Load a comparison: its compare.json, and the receipts and scores of all runs that compare.json names.

    Args:
        home: runs/<scene>, or runs/compare for a folder of scenes.

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
    """Return {method: earlier method} for methods whose stage `evaluate` had the same inputs in every scene."""
    first: dict[tuple[str, ...], str] = {}
    same_as = {}
    for method in methods:
        keys = tuple(runs[method, scene].receipts.get("evaluate", {}).get("key", "") for scene in scenes)
        if all(keys) and first.setdefault(keys, method) != method:
            same_as[method] = first[keys]
    return same_as


def load_run(record: dict[str, Any], runs: Path) -> Run:
    """Load the run of one entry of compare.json.

    Args:
        record: the entry.
        runs: folder to which the entry's paths are relative.
    """
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
        load_view_scores(evaluate / "per_view.csv"),
    )


def shows_object(folders: dict[str, Path], view: str) -> bool:
    """Return whether a view's photograph shows the object: unless it is a test view without an object's mask.

    Args:
        folders: stage -> folder with the stage's results; `poses` is among them.
        view: name of the view.
    """
    is_test = view in load_json(folders["poses"] / "views.json")["test"]
    return not is_test or has_object_mask(folders.get("raw_masks", Path()), folders.get("masks"), view)


def load_receipts(folders: dict[str, Path]) -> dict[str, dict[str, Any]]:
    """Return {stage: content of receipt.json} for the stages that have a receipt.

    A stage whose folder has another stage's name is omitted: scene.yaml may replace a stage by another stage's result,
    whose receipt must count only once.

    Args:
        folders: stage -> folder with the stage's results.
    """
    paths = {stage: folder / "receipt.json" for stage, folder in folders.items() if folder.name == stage}
    return {stage: load_json(path) for stage, path in paths.items() if path.is_file()}


def load_view_scores(path: Path) -> dict[str, dict[str, float]]:
    """Load per_view.csv as {view: {column: number}}, in the file's order; empty if the file does not exist.

    Cells that are empty or no numbers are left out. A PSNR is at most `PSNR_CAP`, also where a view equals the ground
    truth.
    """
    if not path.is_file():
        return {}
    with open(path, newline="", encoding="utf-8") as file:
        rows = {row.pop("view"): row for row in csv.DictReader(file)}
    numbers = {view: {name: _number(name, text) for name, text in row.items()} for view, row in rows.items()}
    return {view: {k: v for k, v in row.items() if v is not None} for view, row in numbers.items()}


def _number(column: str, text: str | None) -> float | None:
    """Return a cell as a number, None if it is empty, no number or NaN; a PSNR is at most `PSNR_CAP`."""
    try:
        value = float(text or "")
    except ValueError:
        return None
    if math.isnan(value):
        return None
    return min(value, PSNR_CAP) if "psnr" in column else value


# ------------------------------------------------------------------------------------------------------- the table


def summarize_methods(comparison: Comparison) -> list[dict[str, Any]]:
    """Return the table of all methods: one dictionary per method with the keys `COLUMNS`, and one for `START`.

    Scores, "consistency", seconds and number of Gaussians are means over the method's finished scenes, None where
    unknown; a scene's score is its mean over test views. "<score>_interval" is half the width of the score's confidence
    interval over scenes (`mean_interval`). "peak_memory_mb" is the maximum over stages and scenes, and "scenes" the
    number of finished scenes. "stand_ins" names the stand-ins (`is_stand_in`) among the method's tools. Differences to
    the full method are means over views, see `Difference`. The row `START` has the scores of the full method before
    `distill`, if they were measured; a method that is better than the full one may still be worse than the start.

    Of a method that computes the same as an earlier method, only "method", "state", "scenes" and "same_as" are filled.
    The methods are sorted by the score `MAIN`, the best first. Methods without this score come next in their order,
    then the duplicates of earlier methods.
    """
    table = [_row(comparison, method) for method in comparison.methods]
    start = dict.fromkeys(COLUMNS) | {"method": START, "state": "done"}
    start |= _mean_scores(comparison.finished_runs(FULL), "initialize")
    table += [start] if any(start[name] is not None for name in SCORES) else []
    table.sort(key=lambda row: (row["same_as"] is not None, row[MAIN] is None, row[MAIN] or 0.0))
    for metric in SCORES:
        differences = differences_to_full(comparison, metric)
        for row in table:
            if difference := differences.get(row["method"]):
                values = (difference.mean, difference.views, difference.scenes)
                row |= {f"{metric}_{what}": value for what, value in zip(DIFFERENCE_COLUMNS, values, strict=True)}
    return table


def _row(comparison: Comparison, method: str) -> dict[str, Any]:
    """Return the row of a method without differences; of a duplicate only names, state and number of scenes."""
    done = comparison.finished_runs(method)
    states = [comparison.runs[method, scene].state for scene in comparison.scenes]
    row: dict[str, Any] = dict.fromkeys(COLUMNS)
    row |= {"method": method, "scenes": len(done)}
    row["state"] = states[0] if len(set(states)) == 1 else f"{len(done)} of {len(states)} done"
    row["same_as"] = comparison.same_as.get(method)
    if row["same_as"]:
        return row
    tools = dict.fromkeys(name for run in done for name in used_tools(run).values())
    row["stand_ins"] = "; ".join(name for name in tools if is_stand_in(name)) or None
    row |= _mean_scores(done, "mean")
    row["consistency"] = finite_mean([view_consistency(run) for run in done])
    row["seconds"] = finite_mean([total_seconds(run) for run in done])
    row["own_seconds"] = finite_mean([own_seconds(run, comparison.runs[FULL, run.scene]) for run in done])
    peaks = [receipt["peak_memory_mb"] for run in done for receipt in run.receipts.values()]
    row["peak_memory_mb"] = max(peaks, default=None)
    counts = finite_mean([run.metrics.get("gaussians", {}).get(run.metrics.get("result")) for run in done])
    row["gaussians"] = None if counts is None else round(counts)
    return row


def _mean_scores(done: list[Run], key: str) -> dict[str, Any]:
    """Return the number of finished runs, and the means and intervals of the scores under a key of metrics.json."""
    found: dict[str, Any] = {"scenes": len(done)}
    for name in SCORES:
        values = [run.metrics.get(key, {}).get(name) for run in done]
        found |= {name: finite_mean(values), f"{name}_interval": mean_interval(values)}
    return found


def used_tools(run: Run) -> dict[str, str]:
    """Return what a run recorded of the tools that it used: "inpainter" (in 2D) and "perceptual" distance -> name.

    The names are recorded in metrics.json, or in facts.json of one of the run's stages.
    """
    paths = [folder / "facts.json" for folder in run.folders.values()]
    records = [run.metrics, *(load_json(path) for path in paths if path.is_file())]
    return {key: facts[key] for facts in records for key in ("inpainter", "perceptual") if facts.get(key)}


def is_stand_in(tool: str) -> bool:
    """Return whether a tool only stands in for the one of the published method: OpenCV for LaMa, D-SSIM for LPIPS."""
    return tool.startswith(("OpenCV", "multi-scale D-SSIM"))


def finite_mean(values: list[float | None]) -> float | None:
    """Return the mean of the values that are finite numbers, or None if no value is."""
    finite = [value for value in values if value is not None and math.isfinite(value)]
    return sum(finite) / len(finite) if finite else None


def mean_interval(values: list[float | None]) -> float | None:
    """Return half the width of Student's 95 % confidence interval of the mean of the values that are finite numbers.

    The result is None if fewer than two values are finite numbers.
    """
    return confidence_half_width(np.array([value for value in values if value is not None and math.isfinite(value)]))


def total_seconds(run: Run) -> float:
    """Return the seconds of all stages of a run, evaluation and stages shared with other methods included."""
    return round(sum(receipt["seconds"] for receipt in run.receipts.values()), 2)


def own_seconds(run: Run, full: Run) -> float | None:
    """Return the seconds of the stages that a run does not share with the full method; 0 for the full method itself.

    Args:
        run: a run of any method.
        full: the run of the full method on the same scene.

    Returns:
        None if the full method's run is not done.
    """
    if full.state != "done":
        return None
    own = [receipt["seconds"] for s, receipt in run.receipts.items() if run.folders[s] != full.folders.get(s)]
    return round(sum(own), 2)


def view_consistency(run: Run) -> float | None:
    """Return the inconsistency between views: the mean absolute color difference of the same points in two views.

    The value is in [0, 1]; less is better. The points are those in the masks, and each view is compared with the next
    view by name. None if metrics.json does not have the value.
    """
    value = (run.metrics.get("consistency") or {}).get("consistency")
    return None if value is None else float(value)


def save_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write the table of methods as .csv, unrounded; missing values are empty cells."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(COLUMNS), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


# ------------------------------------------------------------------------------------------------ against the full one


def differences_to_full(comparison: Comparison, metric: str) -> dict[str, Difference]:
    """Return {method: `Difference` of its scores to the full method's (method minus full)} in one metric.

    Scores are paired over the test views that both methods have. The full method, methods without common views, and
    methods that compute the same as an earlier one are omitted. `START` is among the methods.
    """
    differences = {}
    compared = {method: (method, metric) for method in comparison.distinct_methods if method != FULL}
    for name, (method, column) in {START: (FULL, f"initialize_{metric}"), **compared}.items():
        scenes = []
        for run in comparison.finished_runs(method):
            full = comparison.runs[FULL, run.scene]
            both = [v for v in run.views if column in run.views[v] and metric in full.views.get(v, {})]
            scenes.append(np.array([run.views[v][column] - full.views[v][metric] for v in both]))
        if difference := paired_difference(scenes):
            differences[name] = difference
    return differences
