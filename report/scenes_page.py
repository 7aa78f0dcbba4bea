"""Page of statistics over many scenes: median and quartiles of errors, seconds, memory and scores."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from report import page, trace_charts
from report.job_data import JobFiles

COLUMNS = ("stage", "quantity", "scenes", "quartile_1", "median", "quartile_3")
WHOLE_JOB = "whole job"
SCORES = ("lpips_vgg_box", "psnr_box", "ssim_box", "flip_box")


def make(jobs: list[JobFiles], out: Path) -> Path:
    """Write the page index.html, stages.csv and, if there are traces, stages.png into `out`; return the page's path.

    Args:
        jobs: one per scene, at least one.
        out: folder of the page; created if missing.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows = summarize_stages(jobs)
    with open(out / "stages.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([COLUMNS, *rows])
    title = f"{len(jobs)} scenes"
    parts = [page.heading(title, 1), page.paragraph(", ".join(job.home.name for job in jobs))]
    if curves := main_error_curves(jobs):
        trace_charts.draw_scenes_chart(curves, out / "stages.png")
        parts += [page.heading("Error against seconds"), page.picture(out / "stages.png", "error against seconds")]
        words = "Blue: median and quartiles over the scenes. Gray: each scene. A stage that has ended keeps its error."
        parts.append(page.paragraph(words, quiet=True))
    parts += [page.heading("Median, and quartiles in brackets"), *statistics_tables(rows)]
    parts += [page.heading("Scenes"), scene_table(jobs)]
    path = out / "index.html"
    path.write_text(page.document(title, parts), encoding="utf-8")
    return path


def statistics_tables(rows: list[tuple]) -> list[str]:
    """Return an HTML table with seconds, memory and error of each stage, and a table with the scores if known.

    Args:
        rows: result of `summarize_stages`.
    """
    by_stage: dict[str, dict[str, tuple]] = {}
    for stage, quantity, *values in rows:
        by_stage.setdefault(stage, {})[quantity] = tuple(values)
    lines = []
    for stage, found in by_stage.items():
        errors = [
            f"{trace_charts.axis_title(q)}: {format_quartiles(v)}"
            for q, v in found.items()
            if q in trace_charts.QUANTITIES
        ]
        memory = format_quartiles(found["peak_memory_mb"], 0) if "peak_memory_mb" in found else ""
        lines.append(
            [stage, str(found["seconds"][0]), format_quartiles(found["seconds"], 1), memory, "; ".join(errors)]
        )
    names = [name for name in SCORES if name in by_stage[WHOLE_JOB]]
    result = [["result", *(format_quartiles(by_stage[WHOLE_JOB][name], 2 if "psnr" in name else 4) for name in names)]]
    parts = [page.table(["stage", "scenes", "seconds", "peak MB", "error at its end"], lines, text=(4,))]
    return parts + ([page.table(["mean over test views", *names], result)] if names else [])


def format_quartiles(values: tuple, digits: int | None = None) -> str:
    """Return a text "median [first quartile, third quartile]".

    Args:
        values: result of `quartiles`.
        digits: decimals; None for four significant digits.
    """
    _, low, middle, high = values
    if digits is None:
        return f"{middle:.4g} [{low:.4g}, {high:.4g}]"
    return f"{middle:,.{digits}f} [{low:,.{digits}f}, {high:,.{digits}f}]"


def main_error_curves(jobs: list[JobFiles]) -> dict[str, tuple[str, list[np.ndarray]]]:
    """Return the main error of each stage with its curve in each scene, from the stages' traces.

    The main error of a stage is the quantity that `trace_charts.pick_errors` names first in most scenes. Only the
    series without a name is read.

    Returns:
        Stage -> (name of the quantity, curves [moments, 2] of seconds and value, one for each scene that has it).
    """
    curves: dict[str, tuple[str, list[np.ndarray]]] = {}
    for stage in dict.fromkeys(stage for job in jobs for stage in job.traces):
        traces = [job.traces[stage][""] for job in jobs if job.traces.get(stage, {}).get("")]
        names = [name for lines in traces for name in trace_charts.pick_errors(stage, lines)[:1]]
        if names:
            name = max(names, key=names.count)
            curves[stage] = (
                name,
                [points for lines in traces if len(points := trace_charts.quantity_curve(lines, name))],
            )
    return curves


def summarize_stages(jobs: list[JobFiles]) -> list[tuple]:
    """Return the rows of stages.csv, with the columns `COLUMNS`.

    Each row has the quartiles of one quantity over the scenes that have it. A stage has rows for seconds, peak memory
    in MB and the last value of its main error. The whole job, which comes last, has rows for the sum of its stages'
    seconds and for the scores of the result (means over the test views).
    """
    errors = main_error_curves(jobs)
    rows = []
    for stage in dict.fromkeys(stage for job in jobs for stage in job.receipts):
        receipts = [job.receipts[stage] for job in jobs if stage in job.receipts]
        rows.append((stage, "seconds", *quartiles([receipt["seconds"] for receipt in receipts])))
        rows.append((stage, "peak_memory_mb", *quartiles([receipt["peak_memory_mb"] for receipt in receipts])))
        if stage in errors:
            name, lines = errors[stage]
            rows.append((stage, name, *quartiles([points[-1, 1] for points in lines])))
    whole = [sum(receipt["seconds"] for receipt in job.receipts.values()) for job in jobs]
    rows.append((WHOLE_JOB, "seconds", *quartiles(whole)))
    for name in SCORES:
        values = [job.metrics.get("mean", {}).get(name) for job in jobs]
        if known := [value for value in values if value is not None]:
            rows.append((WHOLE_JOB, name, *quartiles(known)))
    return rows


def quartiles(values: list[float]) -> tuple[int, float, float, float]:
    """Return (number of values, first quartile, median, third quartile) of at least one value."""
    low, middle, high = (float(v) for v in np.percentile(values, [25, 50, 75]))
    return len(values), low, middle, high


def scene_table(jobs: list[JobFiles]) -> str:
    """Return an HTML table with a row per scene: the number of stages done, their seconds, and the scores.

    Args:
        jobs: one per scene.
    """
    names = [n for n in SCORES if any(job.metrics.get("mean", {}).get(n) is not None for job in jobs)]
    rows = []
    for job in jobs:
        seconds = sum(receipt["seconds"] for receipt in job.receipts.values())
        mean = job.metrics.get("mean", {})
        scores = [page.format_number(mean.get(name), 2 if "psnr" in name else 4) for name in names]
        rows.append([job.home.name, str(len(job.receipts)), f"{seconds:.0f}", *scores])
    return page.table(["scene", "stages", "seconds", *names], rows)
