"""Charts of traces and receipts: a stage's error against seconds, a whole job, many scenes.

A stage writes a *trace* (trace.jsonl): lines of an iteration, the seconds of work so far, and quantities such as a loss
or a PSNR. A trace may have several *series* of lines, e.g. one per solver and view. The *main quantity* of a stage
stands for its error; `reffusion.io.traces` lists the quantities and whether more or less is better.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from reffusion.io.traces import MAIN, QUANTITIES
from report.charts import (
    BLUE,
    GRAY,
    GREEN,
    INK,
    ORANGE,
    annotate,
    needs_log_axis,
    new_figure,
    save_chart,
    use_plain_log_ticks,
)
from report.page import format_duration

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Lines = list[dict[str, Any]]  # the lines of one series of a trace
MAX_PANELS = 4  # most errors drawn of one stage
NO_ERRORS = ("sds_gradient_mean", "sds_gradient_max", "gaussians", "masked_gaussians")  # quantities that are not errors


def pick_errors(stage: str, lines: Lines) -> list[str]:
    """Return the names of at most `MAX_PANELS` error quantities that the lines of a trace contain, for a chart.

    The stage's main quantity comes first. If the lines contain no known error, the names of unknown numbers are
    returned instead, in alphabetical order.
    """
    present = {name for line in lines for name, value in line.items() if isinstance(value, int | float)}
    main = [name for name in MAIN.get(stage, ()) if name in present][:1]
    others = [name for name, quantity in QUANTITIES.items() if name in present and quantity.better and name not in main]
    unknown = sorted(present - {"seconds", "iteration", "reason", *QUANTITIES}) if not (main or others) else []
    return [name for name in (*main, *others, *unknown) if name not in NO_ERRORS][:MAX_PANELS]


def axis_title(name: str) -> str:
    """Return the title of an axis: the quantity's label, "dB" if this is its unit, and an arrow.

    The arrow points up if more is better, and down if less is better; there is none if neither is. An unknown name is
    returned unchanged.
    """
    if name not in QUANTITIES:
        return name
    quantity = QUANTITIES[name]
    unit = ", dB" if quantity.unit == "dB" else ""
    return quantity.label[0].upper() + quantity.label[1:] + unit + {"more": " ↑", "less": " ↓", "": ""}[quantity.better]


def best_index(name: str, values: Sequence[float] | np.ndarray) -> int:
    """Return the index of the best value of a quantity: of the largest if more is better, else of the smallest.

    For a quantity that `QUANTITIES` does not list, less counts as better.
    """
    more = name in QUANTITIES and QUANTITIES[name].better == "more"
    return int((np.argmax if more else np.argmin)(values))


def draw_stage_chart(stage: str, series: dict[str, Lines], path: Path) -> list[str]:
    """Draw a stage's main quantities, mostly errors, against seconds of work: a panel for each, a curve per series.

    Args:
        stage: name of the stage; its main quantity comes first. At most `MAX_PANELS` quantities are drawn, see
            `pick_errors`.
        series: name of a series -> lines of the trace.
        path: PNG to write; nothing is written if the lines contain no quantity to draw.

    Returns:
        Names of the quantities drawn; may be empty.
    """
    names = pick_errors(stage, [line for lines in series.values() for line in lines])
    if not names:
        return []
    figure, grid = new_figure(3.0, 1, len(names))
    for axes, name in zip(grid[0], names, strict=True):
        curves = {key: quantity_curve(lines, name) for key, lines in series.items()}
        curves = {key: clamp_first_seconds(points) for key, points in curves.items() if len(points)}
        alone = len(curves) == 1
        for key, points in curves.items():
            words = f" {key}" if 1 < len(curves) <= 4 else ""
            _curve(axes, name, points, BLUE if alone else GRAY, words, main=alone and name == names[0])
        values = np.concatenate([points[:, 1] for points in curves.values()])
        if needs_log_axis(values, 10) and values.min() > 0:
            axes.set_yscale("log")
            use_plain_log_ticks(axes, "y")
        set_time_axis(axes, np.concatenate([points[:, 0] for points in curves.values()]))
        axes.set_title(axis_title(name), fontsize=10, loc="left")
        axes.set_xlabel("seconds of work", fontsize=10)
    save_chart(figure, path)
    return names


def quantity_curve(lines: Lines, name: str) -> np.ndarray:
    """Return a quantity's curve, float64 [moments, 2]: seconds and value, for the lines that have the quantity."""
    return np.array([(line["seconds"], line[name]) for line in lines if name in line], np.float64).reshape(-1, 2)


def _curve(axes: Axes, name: str, points: np.ndarray, color: str, words: str, main: bool) -> None:
    """Draw a curve [moments, 2] (seconds, value) with its last value and `words`; `main` marks the best value too."""
    axes.plot(*points.T, color=color, linewidth=1.8, marker="o", markersize=3)
    last, top = points[-1], points[best_index(name, points[:, 1])]
    annotate(axes, f"{last[1]:.3g}{words}", last, (6, 0), color if main or not words else INK)
    if main and top[1] != last[1]:
        axes.plot(*top, "o", markersize=8, markerfacecolor="none", color=ORANGE)
        annotate(axes, f"best {top[1]:.3g}", top, (-7, 0), ORANGE, ha="right")


def clamp_first_seconds(points: np.ndarray) -> np.ndarray:
    """Return a curve [moments, 2] whose times are at least 1/300 of its last time.

    Earlier moments, such as second 0, are moved to this time, because a logarithmic axis cannot show 0.
    """
    return np.column_stack([np.maximum(points[:, 0], points[:, 0].max() / 300), points[:, 1]])


def set_time_axis(axes: Axes, seconds: np.ndarray) -> None:
    """Use a logarithmic time axis if the latest moment is more than ten times the earliest positive one.

    Traces are written at logarithmically spaced moments. The axis leaves room on the right for a number.

    Args:
        seconds: moments of all curves in the chart.
    """
    if needs_log_axis(seconds, 10):
        axes.set_xscale("log")
        axes.set_xlim(seconds[seconds > 0].min() / 1.1, seconds.max() * 1.9)
        use_plain_log_ticks(axes)
    else:
        axes.margins(x=0.15)


# -------------------------------------------------------------------------------------------------------- one job


def draw_job_chart(
    seconds: dict[str, float],
    traces: dict[str, Lines],
    box: dict[str, float | None],
    path: Path,
    ceiling: float | None = None,
) -> dict[str, float]:
    """Draw PSNR against seconds since the job's beginning, above a bar for each stage's seconds.

    Args:
        seconds: stage -> seconds in its receipt, in the order of the stages.
        traces: stage -> lines of its trace; drawn from the stage's beginning if its main quantity is in dB.
        box: stage -> mean PSNR in dB of the stage's result in the box of the test views, drawn as a point at the
            stage's end; None if unknown.
        path: PNG to write.
        ceiling: mean PSNR in the box of a fit to photographs without the object, drawn as a dashed line; None for no
            line.

    Returns:
        Stage -> seconds since the job's beginning at which the stage began, if the stages ran one after the other.
    """
    begins = dict(zip(seconds, np.cumsum([0.0, *seconds.values()]), strict=False))
    curves = {}
    for stage, lines in traces.items():
        names = [n for n in pick_errors(stage, lines)[:1] if n in QUANTITIES and QUANTITIES[n].unit == "dB"]
        if names and stage in begins:
            curves[stage] = (names[0], quantity_curve(lines, names[0]) + np.array([begins[stage], 0]))
    ends = {stage: (begins[stage] + seconds[stage], v) for stage, v in box.items() if v is not None and stage in begins}
    rows = 2 if curves or ends else 1
    bars = 0.6 + 0.26 * len(seconds)
    ratios = [3.4, bars][-rows:]
    figure, grid = new_figure(sum(ratios), rows, 1, sharex=True, height_ratios=ratios)
    if rows == 2:
        _errors(grid[0, 0], curves, ends, sum(seconds.values()))
        if ceiling is not None:
            grid[0, 0].axhline(ceiling, color="#bbbbbb", linewidth=1.2, linestyle="--", zorder=0)
            words = f"box, a fit to photographs without the object: {ceiling:.2f}"
            annotate(grid[0, 0], words, (0, ceiling), (4, 6))
    _bars(grid[-1, 0], seconds, begins)
    save_chart(figure, path)
    return begins


def _errors(
    axes: Axes, curves: dict[str, tuple[str, np.ndarray]], ends: dict[str, tuple[float, float]], total: float
) -> None:
    """Draw curves in dB, and points (seconds, PSNR) at the ends of stages; `total` is the job's seconds."""
    for (stage, (name, points)), color in zip(curves.items(), (BLUE, GREEN, ORANGE), strict=False):
        axes.plot(*points.T, color=color, linewidth=1.8)
        words = f"{stage}: {QUANTITIES[name].label}, {points[-1, 1]:.1f}"
        late = points[-1, 0] > total / 2  # a label on the right of the curve's end would leave the chart
        annotate(axes, words, points[-1], *(((-8, 4), color, "right") if late else ((6, 0), color)))
    for row, (stage, at) in enumerate(ends.items()):  # labels are staggered, as the points may be close in time
        axes.plot(*at, "D", color=INK, markersize=6)
        words = f"box of the test views\nafter {stage}: {at[1]:.2f}"
        annotate(axes, words, at, (0, -10 - 26 * row), ha="right", va="top")
    finals = [points[-1, 1] for _, points in curves.values()] + [value for _, value in ends.values()]
    highest = max([*finals, *(points[:, 1].max() for _, points in curves.values())])
    axes.set_ylim(min(finals) - 10, highest + 2)  # cuts off the first steps of a fit, at 10 dB
    axes.set_ylabel("PSNR, dB ↑", fontsize=10)


def _bars(axes: Axes, seconds: dict[str, float], begins: dict[str, float]) -> None:
    """Draw a bar for each stage from its begin, as long as its seconds."""
    total = sum(seconds.values())
    for row, (stage, value) in enumerate(seconds.items()):
        axes.barh(row, max(value, total / 500), left=begins[stage], color=GRAY, height=0.62)
        annotate(axes, format_duration(value), (begins[stage] + value, row), (5, 0))
    axes.set_yticks(range(len(seconds)), list(seconds))
    axes.set_ylim(len(seconds) - 0.4, -0.6)
    axes.set_xlim(0, total * 1.1)
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("seconds since the beginning, by the receipts", fontsize=10)


# ----------------------------------------------------------------------------------------------------- many scenes


def quartile_band(curves: Sequence[np.ndarray], count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Return the quartiles of several curves over time.

    A curve is interpolated linearly in the logarithm of time, and keeps its last value after its end.

    Args:
        curves: [moments, 2] each: seconds and value.
        count: number M of moments of the result.

    Returns:
        Seconds [M], logarithmically spaced from the moment when all curves have begun to the moment when the last curve
        has ended, and values [3, M]: first quartile, median, third quartile.
    """
    low = max(max(points[0, 0] for points in curves), 1e-3)
    high = max(max(points[-1, 0] for points in curves), low)
    moments = np.geomspace(low, high, count)
    log = lambda seconds: np.log(np.maximum(seconds, 1e-3))
    values = [np.interp(log(moments), log(points[:, 0]), points[:, 1]) for points in curves]
    return moments, np.percentile(values, [25, 50, 75], axis=0)


def draw_scenes_chart(curves: dict[str, tuple[str, list[np.ndarray]]], path: Path) -> None:
    """Draw one panel per stage with the stage's main quantity in every scene, their median and their quartiles.

    Args:
        curves: stage -> (name of the main quantity, curves [moments, 2] of the scenes: seconds and value).
        path: PNG to write.
    """
    figure, grid = new_figure(3.3, 1, len(curves))
    for axes, (stage, (name, raw)) in zip(grid[0], curves.items(), strict=True):
        lines = [clamp_first_seconds(points) for points in raw]
        for points in lines:
            axes.plot(*points.T, color="#bbbbbb", linewidth=0.8)
        moments, quartiles = quartile_band(lines)
        axes.fill_between(moments, quartiles[0], quartiles[2], color=BLUE, alpha=0.2, linewidth=0)
        axes.plot(moments, quartiles[1], color=BLUE, linewidth=2)
        set_time_axis(axes, np.concatenate([points[:, 0] for points in lines]))
        annotate(axes, f"{quartiles[1, -1]:.3g}", (moments[-1], quartiles[1, -1]), (5, 0), BLUE)
        axes.set_title(f"{stage}, {len(lines)} scenes\n{axis_title(name)}", fontsize=9, loc="left")
        axes.set_xlabel("seconds of work", fontsize=10)
    save_chart(figure, path)
