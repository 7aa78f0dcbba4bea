"""Table of a batch or a comparison, as .csv and .md, with a row per run and means over scenes.

The runner calls this module after each run, so that the table can be read while the batch or the comparison runs.

python -m report.table runs/results.json (or runs/X/compare.json)
"""

from __future__ import annotations

import csv
import io
import json
import os
import sys
from pathlib import Path
from typing import Any


def write_table(record: Path) -> None:
    """Write the table of a record beside the record.

    The files are compare-runs.csv and compare-runs.md for a comparison; for a batch they have the name of the record,
    e.g. results.csv and results.md. The .md of a batch begins with the scenes that failed and the reasons.

    Args:
        record: results.json or results@<variant>.json of a batch, or compare.json of a comparison.
    """
    content = json.loads(record.read_text(encoding="utf-8"))
    is_comparison, runs = "methods" in content, content["runs"]
    keys = ("method", "scene") if is_comparison else ("scene",)
    stem = record.with_name("compare-runs") if is_comparison else record.with_suffix("")
    header, lines = table_rows(runs, keys)
    csv.writer(text := io.StringIO(), lineterminator="\n").writerows([header, *lines])
    _write(Path(f"{stem}.csv"), text.getvalue())
    rows = [" | ".join(cells) for cells in (header, ["---"] * len(header), *lines)]
    failed = [] if is_comparison else [run for run in runs if run["state"] == "failed"]
    reasons = "".join(f"- {run['scene']} failed: {run['error']}\n" for run in failed) + "\n" * bool(failed)
    _write(Path(f"{stem}.md"), reasons + "".join(f"| {row} |\n" for row in rows))


def table_rows(runs: list[dict[str, Any]], keys: tuple[str, ...]) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of the table: one row per run, then one row of means per method.

    All cells are text. A mean is over the scenes that are done and have a value.

    Args:
        runs: entries of the record.
        keys: keys of an entry that name the run: ("method", "scene") or ("scene",).
    """
    names = list(dict.fromkeys(name for run in runs for name in run.get("mean", {})))
    lines = [[*(run[key] for key in keys), run["state"], *_cells(run.get("mean", {}), names)] for run in runs]
    for method in dict.fromkeys(run.get("method", "") for run in runs):
        done = [run["mean"] for run in runs if run.get("method", "") == method and run["state"] == "done"]
        known = {name: [mean[name] for mean in done if isinstance(mean.get(name), int | float)] for name in names}
        means = {name: sum(values) / len(values) for name, values in known.items() if values}
        lines.append([*([method] if len(keys) > 1 else []), f"mean of {len(done)}", "", *_cells(means, names)])
    return [*keys, "state", *names], lines


def _cells(mean: dict[str, Any], names: list[str]) -> list[str]:
    values = (mean.get(name) for name in names)
    return [f"{value:.4f}" if isinstance(value, float) else "" if value is None else str(value) for value in values]


def _write(path: Path, text: str) -> None:
    """Write a file atomically, because a reader may open the file while the batch runs."""
    partial = path.with_name(f".{path.name}.writing")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


if __name__ == "__main__":
    try:
        write_table(Path(sys.argv[1]))
    except OSError as error:
        raise SystemExit(f"error: {error}") from None
