"""Tables and pictures of all methods that `make scene=X compare` ran: runs/X/compare.html and compare.csv.

For a folder of scenes (`make data=FOLDER compare`) the files are runs/compare/compare.html and compare.csv.

A *method* is the full method or one of the variants. The *box* is the bounding box of a view's mask, 10% wider on each
side, in which scores are measured. In many functions `table` is the result of `results.summarize_methods`: one
dictionary per method, whose keys are `results.COLUMNS` and whose values are None where unknown.

python -m report.compare --scene X --runs runs
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from report import charts, cli, compare_pictures, compare_tables, page
from report.results import (
    BOX_SCORES,
    DIFFERENCE_COLUMNS,
    FOLDER_COMPARISON,
    FULL,
    OUTSIDE_SCORES,
    SCORES,
    START,
    Comparison,
    Run,
    differences_to_full,
    load_comparison,
    save_csv,
    summarize_methods,
    used_tools,
)

TITLES = {
    "method": "method",
    "lpips_vgg_box": "LPIPS (vgg) ↓",
    "lpips_alex_box": "LPIPS (alex) ↓",
    "psnr_box": "PSNR, dB ↑",
    "ssim_box": "SSIM ↑",
    "flip_box": "FLIP ↓",
    "psnr_outside": "outside: PSNR ↑",
    "ssim_outside": "outside: SSIM ↑",
    "flip_outside": "outside: FLIP ↓",
    "consistency": "consistency ↓",
    "seconds": "seconds",
    "own_seconds": "own seconds",
    "peak_memory_mb": "peak MB",
    "gaussians": "Gaussians",
}
DIGITS = {"lpips_vgg_box": 4, "lpips_alex_box": 4, "psnr_box": 2, "ssim_box": 4, "flip_box": 4}
DIGITS |= {"consistency": 5}
DIGITS |= {"psnr_outside": 2, "ssim_outside": 4, "flip_outside": 4}
ERRORS = {"lpips_vgg_box": "LPIPS (vgg) in the box", "flip_box": "FLIP in the box", "ssim_box": "1 − SSIM in the box"}
SHORT = {"lpips_vgg_box": "LPIPS (vgg)", "lpips_alex_box": "LPIPS (alex)"}
SHORT |= {"psnr_box": "PSNR, dB", "ssim_box": "SSIM", "flip_box": "FLIP"}
SHORT |= {"psnr_outside": "PSNR outside, dB", "ssim_outside": "SSIM outside", "flip_outside": "FLIP outside"}
# Columns that are omitted if no method has a value.
OPTIONAL_COLUMNS = ("consistency", "lpips_vgg_box", "lpips_alex_box", *OUTSIDE_SCORES)
FACTS = {"inpainter": "2D inpainter", "perceptual": "perceptual distance"}  # keys of `used_tools`


def make(home: Path) -> dict[str, Path]:
    """Write the table (.csv) and the page (.html) of a comparison; return their paths as {"csv", "html"}.

    Pictures are written to `home`/compare/. The page embeds the pictures, so that it needs no other file.

    Args:
        home: folder of the comparison: runs/<scene>, or runs/compare for a folder of scenes.

    Raises:
        ValueError: nothing was compared yet, or FOLDER/published.csv is malformed.
    """
    comparison = load_comparison(home)
    out = home / "compare"
    out.mkdir(exist_ok=True)
    for chart in ("tradeoff", "differences"):  # an earlier call may have drawn a chart for which there is no data now
        (out / f"{chart}.png").unlink(missing_ok=True)
    table = summarize_methods(comparison)
    paths = {kind: home / f"compare.{kind}" for kind in ("csv", "html")}
    save_csv(paths["csv"], table)
    charts_drawn = {
        "Error against run time": save_tradeoff(table, out / "tradeoff.png"),
        "Difference to the full method": save_forest(comparison, out / "differences.png"),
    }
    views = compare_pictures.save_sheets(comparison, out)
    paths["html"].write_text(html(comparison, table, charts_drawn, views), encoding="utf-8")
    return paths


# -------------------------------------------------------------------------------------------------------- figures


def save_tradeoff(table: list[dict[str, Any]], path: Path) -> Path | None:
    """Draw the methods' errors against their run times; return the chart's path, or None if there is nothing to draw.

    The errors are LPIPS (vgg), FLIP and 1 - SSIM in the box, as far as any method has them. If no method has any of
    them, the chart shows the inconsistency between views instead. Only methods that have all drawn errors appear. A run
    time is that of all stages of a scene, evaluation included.
    """
    errors = {}
    for name, title in {**ERRORS, "consistency": "inconsistency between views"}.items():
        rows = [row for row in table if row[name] is not None]
        if rows and not (name == "consistency" and errors):
            errors[title] = {row["method"]: 1 - row[name] if name == "ssim_box" else row[name] for row in rows}
    timed = [row for row in table if row["seconds"] is not None]
    common = [row for row in timed if errors and all(row["method"] in values for values in errors.values())]
    if not common:
        return None
    names, seconds = [row["method"] for row in common], [row["seconds"] for row in common]
    charts.draw_tradeoff(names, seconds, {title: [values[n] for n in names] for title, values in errors.items()}, path)
    return path


def save_forest(comparison: Comparison, path: Path) -> Path | None:
    """Draw each method's score minus the full method's score, with confidence intervals, as a forest chart.

    The chart shows the scores in the box, or the scores outside the masks if no differences in the box are known.

    Returns:
        The chart's path, or None if there is nothing to draw.
    """
    differences = {metric: by_method for metric in BOX_SCORES if (by_method := differences_to_full(comparison, metric))}
    differences = differences or {
        metric: by_method for metric in OUTSIDE_SCORES if (by_method := differences_to_full(comparison, metric))
    }
    if not differences:
        return None
    more = {metric for metric, better in SCORES.items() if better == "more"}
    charts.draw_forest(differences, {metric: f"{SHORT[metric]}, minus full" for metric in differences}, more, path)
    return path


# --------------------------------------------------------------------------------------------------------- tables


def method_table(table: list[dict[str, Any]]) -> tuple[list[str], list[list[str]], list[list[bool]]]:
    """Return the main table as (header, cells, bold).

    Returns:
        header: titles of the columns. Columns of `OPTIONAL_COLUMNS` are omitted if no method has a value.
        cells: text [rows][columns], one row per method; a dash marks a missing value.
        bold: [rows][columns], True for the values of a score that equal the best one after rounding. The best value is
            that of the methods with the most finished scenes. There is no best value in columns that are no scores,
            such as "seconds" and "consistency", nor in a score that only one of these methods has.
    """
    names = [name for name in TITLES if name not in OPTIONAL_COLUMNS or any(row[name] is not None for row in table)]
    best = {}
    most = max(row["scenes"] for row in table)
    # No value of `consistency` is marked as best, because blurred renders are consistent too. A mean over fewer scenes
    # than other methods have is not considered either.
    for name, better in SCORES.items():
        values = [round(row[name], DIGITS[name]) for row in table if row[name] is not None and row["scenes"] == most]
        best[name] = (max if better == "more" else min)(values, default=None) if len(values) > 1 else None
    texts, bold = [], []
    for row in table:
        state = f" ({row['state']})" if row["state"] != "done" else f" = {row['same_as']}" if row["same_as"] else ""
        state += " *" if row["stand_ins"] else ""
        texts.append([row["method"] + state if n == "method" else _cell(row, n) for n in names])
        bold.append(
            [best.get(n) is not None and row[n] is not None and round(row[n], DIGITS[n]) == best[n] for n in names]
        )
    return [TITLES[name] for name in names], texts, bold


def _cell(row: dict[str, Any], name: str) -> str:
    """Return the cell of a method's row in the column `name` as text; scores with their interval."""
    digits = DIGITS.get(name, 0)
    return compare_tables.format_spread(row, name, digits) if name in SCORES else page.format_number(row[name], digits)


def difference_table(table: list[dict[str, Any]]) -> tuple[list[str], list[list[str]]] | None:
    """Return header and rows of the table of differences: each method's score minus the full method's score.

    There is a row for each method, without the full one and duplicates of earlier methods, and a column for each metric
    in which a difference is known. A cell has the mean difference, half the width of its 95% confidence interval over
    views and, in brackets, half the width of its interval over scenes if there are several. The result is None if no
    differences are known.
    """
    metrics = [metric for metric in SCORES if any(row[f"{metric}_minus_full"] is not None for row in table)]
    others = [row for row in table if row["method"] != FULL and not row["same_as"]]
    lines = [[row["method"], *(_signed(row, metric) for metric in metrics)] for row in others]
    return (["method", *(SHORT[metric] for metric in metrics)], lines) if metrics else None


def _signed(row: dict[str, Any], metric: str) -> str:
    """Return a method's difference to the full method as text with its intervals; a dash if it is unknown."""
    mean, views, scenes = (row[f"{metric}_{what}"] for what in DIFFERENCE_COLUMNS)
    if mean is None:
        return "–"
    text = f"{mean:+.{DIGITS[metric]}f}".replace("-", "−")
    text += "" if views is None else f" ± {views:.{DIGITS[metric]}f}"
    return text if scenes is None else f"{text} (± {scenes:.{DIGITS[metric]}f})"


def extra_tables(comparison: Comparison, table: list[dict[str, Any]]) -> dict[str, compare_tables.Table]:
    """Return the further tables as {title: (header, rows)}.

    If there are several scenes, each score in the box gets a table with its values in each scene. If the folder of the
    scenes has published.csv, a table shows published scores beside the measured ones.

    Raises:
        ValueError: FOLDER/published.csv is malformed.
    """
    tables: dict[str, compare_tables.Table] = {}
    if len(comparison.scenes) > 1:
        each = {metric: compare_tables.scene_table(comparison, table, metric, DIGITS[metric]) for metric in BOX_SCORES}
        tables |= {f"{SHORT[metric]} in each scene": scene_table for metric, scene_table in each.items() if scene_table}
    if published := compare_tables.load_published(comparison.data):
        done = [run for method in comparison.methods for run in comparison.finished_runs(method)]
        protocol = " ".join(compare_tables.describe_protocol(done))
        tables["Published, and here"] = compare_tables.published_table(published, table, SHORT, DIGITS, protocol)
    return tables


# ---------------------------------------------------------------------------------------------------------- words


def summary(comparison: Comparison, table: list[dict[str, Any]]) -> str:
    """Return a sentence with the numbers of methods and scenes, and the best method in each metric.

    The metrics are those in the box, or those outside the masks if no method has a PSNR in the box. All methods that
    are best after rounding are named. Only the methods with the most finished scenes are considered.
    """
    done = sum(run.state == "done" for run in comparison.runs.values())
    place = f"{len(comparison.scenes)} scenes ({', '.join(comparison.scenes)})"
    parts = [f"{len(comparison.methods)} methods on {place if len(comparison.scenes) > 1 else comparison.scenes[0]}"]
    parts[0] += "" if done == len(comparison.runs) else f", {done} of {len(comparison.runs)} runs done"
    boxed = any(row["psnr_box"] is not None for row in table)
    most = max(row["scenes"] for row in table)
    for metric, better in (BOX_SCORES if boxed else OUTSIDE_SCORES).items():
        rows = [row for row in table if row[metric] is not None and row["scenes"] == most]
        if len(rows) > 1:
            rounded = [round(row[metric], DIGITS[metric]) for row in rows]
            best = (max if better == "more" else min)(rounded)
            tied = [row["method"] for row, value in zip(rows, rounded, strict=True) if value == best]
            parts.append(f"best in {SHORT[metric].removesuffix(', dB')}: {' and '.join(tied)}")
    return "; ".join(parts) + "."


def table_notes(comparison: Comparison, table: list[dict[str, Any]]) -> list[str]:
    """Return the notes below the tables: definitions of columns, protocol, failed runs and machines, one per item."""
    done = [run for method in comparison.methods for run in comparison.finished_runs(method)]
    lines = [
        "Box: the bounding box of the view's mask, 10% wider on each side. Means over the test views"
        + (" and the scenes; ± half the 95% interval over the scenes." if len(comparison.scenes) > 1 else "."),
        *(f"Scored: {words}." for words in compare_tables.describe_protocol(done)),
        "seconds: all stages of the method, evaluation included, from their receipts. own seconds: the stages that it "
        "does not share with the full method. peak MB: the stage that takes most memory.",
        *([f"{START}: the scene before distillation."] if any(row["method"] == START for row in table) else []),
    ]
    if not any(run.metrics.get("mean", {}).get("psnr_box") is not None for run in done):
        lines.append("No box metrics: the scene has no ground truth.")
    if any(run.metrics.get("mean", {}).get("psnr_outside") is not None for run in done):
        lines.append(
            "outside: pixels of the test views outside their masks (widened by 1% of the width), which all methods "
            "should leave as they are."
        )
    lines += dict.fromkeys(f"No LPIPS: {why}." for run in done if (why := run.metrics.get("lpips_unavailable")))
    if any(row["consistency"] is not None for row in table):
        words = "mean absolute difference to the next view in the mask, by rendered depth; blur is consistent too."
        lines.append(f"consistency: {words}")
    if stand_ins := dict.fromkeys(name for row in table if row["stand_ins"] for name in row["stand_ins"].split("; ")):
        lines.append(f"*: {', '.join(stand_ins)} stands in for LaMa or LPIPS, with which the published method works.")
    lines += [f"{method} is the very same job as {other} here." for method, other in comparison.same_as.items()]
    lines += dict.fromkeys(words for run in done for words in method_facts(run))
    for run in done:
        resumed = [stage for stage, receipt in run.receipts.items() if receipt.get("resumed")]
        if resumed:
            lines.append(f"{run.method} on {run.scene}: {', '.join(resumed)} resumed; seconds are incomplete.")
    lines += [f"{r.method} on {r.scene} failed: {r.error}" for r in comparison.runs.values() if r.state == "failed"]
    receipts = [receipt for run in done for receipt in run.receipts.values()]
    machines = dict.fromkeys(f"{r.get('device', 'cpu')} of {r.get('machine', '?')}, {r['profile']}" for r in receipts)
    return [*lines, f"Ran on: {'; '.join(machines)}."] if machines else lines


def method_facts(run: Run) -> list[str]:
    """Return a list of one sentence with the 2D inpainter and the perceptual distance that a run used.

    The list is empty if neither is recorded.
    """
    named = [f"{FACTS[key]} {name}" for key, name in used_tools(run).items()]
    return [f"{run.method}: {', '.join(named)}."] if named else []


def explain_intervals(comparison: Comparison) -> str:
    """Return a sentence that explains the intervals in the table of differences and in the forest chart."""
    text = "Method minus full, ± half the 95% interval of the paired t over pairs of equal views"
    if len(comparison.scenes) == 1:
        return f"{text} (the line through a dot). It holds for this scene, not for others."
    return (
        f"{text} of all {len(comparison.scenes)} scenes (thick lines), which holds for these scenes; in brackets over "
        "the scenes' means (thin lines), which holds for another scene of their kind."
    )


def terminal_text(comparison: Comparison) -> str:
    """Return the summary and the main table as text for a terminal."""
    table = summarize_methods(comparison)
    header, texts, _ = method_table(table)
    return f"{summary(comparison, table)}\n\n{page.markdown_table(header, texts)}"


def html(comparison: Comparison, table: list[dict], chart_paths: dict[str, Path | None], views: dict[str, Path]) -> str:
    """Return the page in HTML with all pictures embedded.

    Args:
        chart_paths: title -> PNG of a chart, or None if the chart was not drawn.
        views: view -> PNG with the results of all methods in this view.
    """
    header, texts, bold = method_table(table)
    title = f"{comparison.name}: methods compared"
    full = next((number for number, row in enumerate(table) if row["method"] == FULL), None)
    body = [page.heading(title, 1), page.paragraph(summary(comparison, table))]
    body += [page.table(header, texts, bold=bold, marked=full)]
    for heading, further in extra_tables(comparison, table).items():
        body += [page.heading(heading), page.table(*further)]
    for heading, path in chart_paths.items():
        body += [page.heading(heading), page.picture(path, heading, embed=True)] if path else []
    if differences := difference_table(table):
        dots = " Orange and blue dots: the interval over views excludes zero. An arrow: beyond the axis."
        body += [page.paragraph(explain_intervals(comparison) + dots, quiet=True), page.table(*differences)]
    if views:
        body += [page.heading("The same views"), page.paragraph("Crops of the box with a margin.", quiet=True)]
    for view, path in views.items():
        body += [page.heading(view, 3), page.picture(path, f"{view} by every method", embed=True)]
    return page.document(title, [*body, page.heading("Notes"), page.bullets(table_notes(comparison, table))])


@cli.command
def main() -> None:
    """Run `reffusion compare-page`: write table and page of a comparison; print the summary and the paths."""
    parser = argparse.ArgumentParser(prog="reffusion compare-page", description=__doc__.split("\n")[0])
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--scene", type=Path, help="name of the scene, or path of its folder")
    what.add_argument("--data", type=Path, help="the folder whose scenes were compared last")
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    arguments = parser.parse_args()
    name = cli.name_scene(arguments.scene) if arguments.scene else FOLDER_COMPARISON
    paths = make(home := arguments.runs / name)
    print(terminal_text(load_comparison(home)), *paths.values(), sep="\n")


if __name__ == "__main__":
    main()
