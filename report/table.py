"""Table of a batch, as .csv and .md, with a row per scene and means over the scenes.

The runner calls this module after each scene, so that the table can be read while the batch runs.

python -m report.table runs/results.json
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
    """Write the table of a batch beside its record, e.g. results.csv and results.md.

    The .md begins with the scenes that failed and the reasons.

    Args:
        record: results.json or results@<variant>.json.
    """
    runs = json.loads(record.read_text(encoding="utf-8"))["runs"]
    header, lines = table_rows(runs)
    csv.writer(text := io.StringIO(), lineterminator="\n").writerows([header, *lines])
    _write(record.with_suffix(".csv"), text.getvalue())
    rows = [" | ".join(cells) for cells in (header, ["---"] * len(header), *lines)]
    failed = [run for run in runs if run["state"] == "failed"]
    reasons = "".join(f"- {run['scene']} failed: {run['error']}\n" for run in failed) + "\n" * bool(failed)
    _write(record.with_suffix(".md"), reasons + "".join(f"| {row} |\n" for row in rows))


def table_rows(runs: list[dict[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of the table: one row per scene, then one row of means.

    All cells are text, "" for a missing value. A mean is over the scenes that are done and have a value.

    Args:
        runs: entries of the record.
    """
    names = list(dict.fromkeys(name for run in runs for name in run.get("mean", {})))
    lines = [[run["scene"], run["state"], *_cells(run.get("mean", {}), names)] for run in runs]
    done = [run["mean"] for run in runs if run["state"] == "done"]
    known = {name: [mean[name] for mean in done if isinstance(mean.get(name), int | float)] for name in names}
    means = {name: sum(values) / len(values) for name, values in known.items() if values}
    return ["scene", "state", *names], [*lines, [f"mean of {len(done)}", "", *_cells(means, names)]]


def _cells(mean: dict[str, Any], names: list[str]) -> list[str]:
    """Return the scores of these names as text, "" where one is missing."""
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
