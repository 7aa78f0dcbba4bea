"""Tables of a comparison over several scenes: each method in each scene, and published scores beside the measured ones.

In these functions `table` is the result of `results.summarize_methods`: one dictionary per method.
"""

from __future__ import annotations

import csv
from pathlib import Path

from report import page
from report.results import BOX_SCORES, Comparison, Run

PUBLISHED = "published.csv"  # file in the folder of the scenes
COLUMNS = ("method", "metric", "value", "protocol")
Table = tuple[list[str], list[list[str]]]  # header, rows


def scene_table(comparison: Comparison, table: list[dict], metric: str, digits: int) -> Table | None:
    """Return a table of one metric with a row per method: the score in each scene, then the mean as in `table`.

    Duplicates of earlier methods get no row. A score in a scene is the mean over the scene's test views.

    Args:
        digits: decimals of the scores.

    Returns:
        Header and rows, or None if no method has this score.
    """
    means = {row["method"]: row[metric] for row in table}
    methods = comparison.distinct_methods
    if all(means[method] is None for method in methods):
        return None
    lines = []
    for method in methods:
        runs = [comparison.runs[method, scene] for scene in comparison.scenes]
        values = [run.metrics.get("mean", {}).get(metric) if run.state == "done" else None for run in runs]
        lines.append([method, *(page.format_number(value, digits) for value in [*values, means[method]])])
    return ["method", *comparison.scenes, "mean"], lines


def describe_protocol(done: list[Run]) -> list[str]:
    """Return a phrase that says which views were rendered, and at which size, in which scenes.

    Args:
        done: finished runs.

    Returns:
        A list of one phrase; empty if the runs did not record the size.
    """
    scenes_by_size: dict[str, dict[str, None]] = {}
    for run in done:
        sizes = ", ".join(run.metrics.get("protocol", {}).get("resolution", ()))
        if sizes:
            scenes_by_size.setdefault(f"{run.metrics['rendered']} of {sizes} px", {})[run.scene] = None
    groups = [f"{what} ({', '.join(scenes)})" for what, scenes in scenes_by_size.items()]
    return ["; ".join(groups)] if groups else []


def load_published(data: Path | None) -> list[dict[str, str]]:
    """Load the published scores in published.csv of the scenes' folder: a dictionary with keys `COLUMNS` per row.

    Args:
        data: folder of the scenes; None if a single scene was compared.

    Returns:
        Empty if there is no such file.

    Raises:
        ValueError: the file has other columns, a metric that is none of `BOX_SCORES`, or a value that is not a number.
    """
    path = data / PUBLISHED if data else None
    if path is None or not path.is_file():
        return []
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for number, row in enumerate(rows, 2):
        if set(row) != set(COLUMNS):
            raise ValueError(f"{path}: its columns are {', '.join(map(str, row))}; expected {', '.join(COLUMNS)}")
        if row["metric"] not in BOX_SCORES:
            raise ValueError(f"{path}: line {number}: metric {row['metric']!r} is none of {', '.join(BOX_SCORES)}")
        try:
            float(row["value"])
        except (TypeError, ValueError):
            raise ValueError(f"{path}: line {number}: {row['value']!r} is no number") from None
    return rows


def published_table(
    rows: list[dict[str, str]], table: list[dict], short: dict[str, str], digits: dict[str, int], protocol: str
) -> Table:
    """Return a table with the published scores of each metric, followed by the measured ones with their intervals.

    Args:
        rows: published scores, from `load_published`.
        short: metric -> name to show.
        digits: metric -> decimals.
        protocol: how the measured scores were obtained, in words.
    """
    lines = []
    for metric in dict.fromkeys(row["metric"] for row in rows):
        lines += [
            [row["method"], "published", short[metric], row["value"], row["protocol"]]
            for row in rows
            if row["metric"] == metric
        ]
        ours = [row for row in table if row[metric] is not None]
        lines += [
            [row["method"], "here", short[metric], format_spread(row, metric, digits[metric]), protocol] for row in ours
        ]
    return ["method", "from", "metric", "mean over scenes", "protocol"], lines


def format_spread(row: dict, metric: str, digits: int) -> str:
    """Return a method's mean score as text; with several scenes, ± half the width of its 95 % confidence interval.

    The interval is over scenes. A dash stands for a missing score.

    Args:
        row: the method's row of the table.
        digits: decimals.
    """
    half = row[f"{metric}_interval"]
    return page.format_number(row[metric], digits) + ("" if half is None else f" ± {half:.{digits}f}")
