"""Common style of all charts, and charts of a comparison: error against run time, differences to the full method."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reffusion.io.images import save_image
from report.paired_statistics import Difference, pareto_front

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, which color-blind readers can tell apart.
BLUE, ORANGE, GREEN, GRAY, INK = "#0072B2", "#D55E00", "#009E73", "#8a8a8a", "#222222"
WIDTH, DPI = 9.6, 200  # inches (page width) and dots per inch
LABEL_GAP = 12  # least horizontal distance of a label to its neighbors, px
LABEL_OFFSETS = [(6, 0), (-6, 0), (5, 7), (-5, 7), (5, -7), (-5, -7), (0, 10), (0, -10),
          (14, 14), (-14, 14), (14, -14), (-14, -14), (0, 22), (0, -22), (26, 24), (-26, 24), (26, -24), (-26, -24),
          (0, 34), (0, -34), (40, 34), (-40, 34), (40, -34), (-40, -34)]  # fmt: skip


def new_figure(height: float, rows: int = 1, columns: int = 1, **options) -> tuple[Figure, np.ndarray]:
    """Return a figure of page width and an array of its axes [rows, columns], in the common style.

    Args:
        height: height of the figure, inches.
        options: further options of matplotlib's `Figure.subplots`.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    chart = Figure((WIDTH, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(chart)
    grid = chart.subplots(rows, columns, squeeze=False, **options)
    for axes in grid.flat:
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color("#999")
        axes.tick_params(colors=INK, labelsize=9, color="#999")
        axes.grid(color="#eee", linewidth=0.8)
        axes.set_axisbelow(True)
    return chart, grid


def save_chart(chart: Figure, path: Path) -> None:
    """Draw a figure and save it as a PNG."""
    chart.canvas.draw()
    save_image(path, np.asarray(chart.canvas.buffer_rgba())[..., :3].copy())


def annotate(axes: Axes, text: str, at, offset=(0, 0), color: str = INK, ha: str = "left", va: str = "center") -> None:
    """Write text beside a data point of a chart.

    Args:
        at: (x, y) of the data point.
        offset: (x, y) from the data point to the text, in points (1/72 inch).
        ha: horizontal alignment of the text.
        va: vertical alignment of the text.
    """
    look = {"fontsize": 9, "color": color, "ha": ha, "va": va}
    axes.annotate(text, at, offset, textcoords="offset points", **look)


def needs_log_axis(values: Iterable[float], factor: float = 12) -> bool:
    """Return True if the largest value is more than `factor` times the smallest positive value.

    A logarithmic axis then shows the values better than a linear axis.
    """
    positive = [value for value in values if value > 0]
    return len(positive) > 1 and max(positive) > factor * min(positive)


def use_plain_log_ticks(axes: Axes, which: str = "x") -> None:
    """Label a logarithmic axis, "x" or "y", with plain numbers (10, 100) instead of powers (10^1, 10^2).

    Numbers in between (20, 50) are labeled too if the axis's current upper limit is less than 300 times the lower one.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis = axes.xaxis if which == "x" else axes.yaxis
    low, high = axes.get_xlim() if which == "x" else axes.get_ylim()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high / max(low, 1e-12) < 300 else (1,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


# ------------------------------------------------------------------------------------------- error against run time


def draw_tradeoff(
    names: Sequence[str], seconds: Sequence[float], errors: dict[str, Sequence[float]], path: Path
) -> None:
    """Draw the errors of all methods against their run times, one panel per kind of error, with the Pareto front.

    Args:
        names: names of the n methods.
        seconds: run times [n].
        errors: title of a panel -> errors [n] of the methods; less is better.
        path: PNG to write.
    """
    chart, grid = new_figure(0.5 + 3.6 * len(errors), len(errors), sharex=True)
    for axes, (title, values) in zip(grid[:, 0], errors.items(), strict=True):
        front = pareto_front(seconds, values)
        order = np.argsort(np.asarray(seconds)[front], kind="stable")
        steps = np.column_stack([seconds, values])[front][order]
        axes.step(steps[:, 0], steps[:, 1], where="post", color=BLUE, linewidth=1.2, alpha=0.6)
        axes.plot(*np.column_stack([seconds, values])[~front].T, "o", color=GRAY, markersize=6, markerfacecolor="white")
        axes.plot(*steps.T, "o", color=BLUE, markersize=7)
        axes.set_ylabel(title, fontsize=10)
        if needs_log_axis(seconds):
            axes.set_xscale("log")
            use_plain_log_ticks(axes)
        else:
            low, high = min(seconds), max(seconds)
            axes.set_xlim(0 if low < 0.3 * high else low - 0.15 * (high - low), high + 0.15 * (high - low) or None)
        axes.set_ylim(0, max(values) * 1.12 or 1)
    grid[-1, 0].set_xlabel("seconds of the whole job, evaluation included", fontsize=10)
    note = "filled, on the line: Pareto front (no other method is both as fast and as good)"
    grid[0, 0].set_title(note, fontsize=9, color=BLUE, loc="left")
    chart.canvas.draw()  # computes the layout, which must not change after the labels are placed
    chart.set_layout_engine("none")
    for axes, values in zip(grid[:, 0], errors.values(), strict=True):
        label_points(axes, np.column_stack([seconds, values]), names, pareto_front(seconds, values))
    save_chart(chart, path)


def label_points(axes: Axes, points: np.ndarray, names: Sequence[str], strong: np.ndarray) -> None:
    """Write the name of each point beside the point, where it covers other points, other names and the front least.

    A thin line connects a name to its point if the two are far apart. The layout and the limits of the axes must be
    final, because the overlap is measured in px.

    Args:
        points: [n, 2] in data units.
        names: [n].
        strong: bool [n], True for the points on the Pareto front.
    """
    renderer = axes.figure.canvas.get_renderer()
    unit = axes.figure.dpi / 72
    pixels = axes.transData.transform(points)
    obstacles = [np.array([x - 5 * unit, y - 5 * unit, x + 5 * unit, y + 5 * unit]) for x, y in pixels]
    steps = pixels[strong][np.argsort(pixels[strong][:, 0], kind="stable")]
    for (x, y), (to_x, to_y) in pairwise(steps):  # names must not cover the line of the Pareto front either
        obstacles += [np.array([x, y - unit, to_x, y + unit]), np.array([to_x - unit, to_y, to_x + unit, y])]
    inside = axes.get_window_extent(renderer)
    for index in np.argsort(-pixels[:, 0], kind="stable"):
        color = BLUE if strong[index] else INK
        text = axes.annotate(
            names[index], points[index], (0, 0), textcoords="offset points", fontsize=9, color=color, va="bottom",
            weight="bold" if names[index] == "full" else "normal",
        )  # fmt: skip
        wide, high = text.get_window_extent(renderer).size
        boxes = [_box(pixels[index], place, wide, high, unit) for place in LABEL_OFFSETS]
        others = [box for number, box in enumerate(obstacles) if number != index]
        costs = [_cost(box, place, others, inside) for box, place in zip(boxes, LABEL_OFFSETS, strict=True)]
        best = int(np.argmin(costs))
        obstacles.append(boxes[best])
        corner = (boxes[best][:2] - pixels[index]) / unit
        text.set_position(tuple(corner))
        if np.hypot(*LABEL_OFFSETS[best]) > 12:
            end = np.array(LABEL_OFFSETS[best]) * 0.85
            line = {"arrowstyle": "-", "color": "#bbb", "linewidth": 0.7, "shrinkA": 0, "shrinkB": 4}
            axes.annotate("", points[index], tuple(end), textcoords="offset points", arrowprops=line)


def _box(point: np.ndarray, place: tuple[float, float], wide: float, high: float, unit: float) -> np.ndarray:
    """Return the box [left, bottom, right, top], px, of a text at `place` (in points, `unit` px each) from `point`."""
    x, y = point + np.array(place) * unit
    # A positive offset puts the text on the right of the point, a negative one on the left, and 0 centers it.
    left = x - wide / 2 if place[0] == 0 else x if place[0] > 0 else x - wide
    return np.array([left, y - high / 2, left + wide, y + high / 2])


def _cost(box: np.ndarray, place: tuple[float, float], boxes: list[np.ndarray], inside) -> float:
    """Return the cost of placing a text in `box`: its overlap with other boxes in px^2, plus penalties."""
    box = box + np.array([-LABEL_GAP, 0, LABEL_GAP, 0])
    covered = sum(
        max(0, min(box[2], other[2]) - max(box[0], other[0])) * max(0, min(box[3], other[3]) - max(box[1], other[1]))
        for other in boxes
    )
    outside = max(0, inside.x0 - box[0], box[2] - inside.x1) + max(0, inside.y0 - box[1], box[3] - inside.y1)
    # The largest penalty is for leaving the axes (`inside`), the smallest for the distance to the point in 1/72 inch.
    return covered + 1000 * outside + 2 * float(np.hypot(*place))


# --------------------------------------------------------------------------------------- differences to the full one


def draw_forest(
    differences: dict[str, dict[str, Difference]], titles: dict[str, str], more: set[str], path: Path
) -> None:
    """Draw one panel per metric with each method's difference to the full method and its confidence intervals.

    The left side of a panel is always worse than the full method. A difference is blue (better) or orange (worse) if
    its interval over views excludes zero, else gray. A thick line is the interval over views, a thin line the interval
    over scenes. A difference whose absolute value is more than three times the panel's median absolute difference is
    drawn as an arrow with the number.

    Args:
        differences: metric -> method -> the method's score minus the full method's score.
        titles: metric -> title of its axis.
        more: metrics of which more is better.
        path: PNG to write.
    """
    names = list(dict.fromkeys(name for by_method in differences.values() for name in by_method))
    chart, grid = new_figure(0.9 + 0.3 * len(names), 1, len(differences), sharey=True)
    for axes, (metric, by_method) in zip(grid[0], differences.items(), strict=True):
        axes.axvline(0, color=INK, linewidth=1)
        axes.grid(axis="y", visible=False)
        far = _far(list(by_method.values()))
        for row, name in enumerate(names):
            if name in by_method:
                _interval(axes, by_method[name], row, 1 if metric in more else -1, far)
        axes.set_xlabel(titles[metric], fontsize=10)
        if metric not in more:
            axes.invert_xaxis()
        axes.locator_params(axis="x", nbins=4)
    grid[0, 0].set_yticks(range(len(names)), names)
    grid[0, 0].set_ylim(len(names) - 0.4, -0.6)
    grid[0, 0].set_title("← worse than full", fontsize=9, color=ORANGE, loc="left")
    grid[0, -1].set_title("better than full →", fontsize=9, color=BLUE, loc="right")
    save_chart(chart, path)


def _interval(axes: Axes, difference: Difference, row: int, sign: int, far: float) -> None:
    """Draw a method's difference and its intervals into a row; `sign` is 1 if more of the metric is better, else -1."""
    mean, views = difference.mean, difference.views or 0
    color = GRAY if abs(mean) <= views else BLUE if sign * mean > 0 else ORANGE
    if abs(mean) > far:  # does not fit the panel: drawn as an arrow with the number
        worse = sign * mean < 0
        words = f"◂ {mean:+.2g}" if worse else f"{mean:+.2g} ▸"
        at = {"ha": "left" if worse else "right", "va": "center", "transform": axes.get_yaxis_transform()}
        axes.text(0.01 if worse else 0.99, row, words.replace("-", "−"), fontsize=9, color=color, **at)
        return
    if difference.scenes:
        center = difference.scenes_mean
        ends = np.clip([center - difference.scenes, center + difference.scenes], -far, far)
        axes.plot(ends, [row, row], color=color, linewidth=1.2, solid_capstyle="butt")
    axes.plot([mean - views, mean + views], [row, row], color=color, linewidth=4, solid_capstyle="butt")
    axes.plot(mean, row, "o", markersize=6, color=color)


def _far(differences: Sequence[Difference]) -> float:
    """Return the largest absolute mean difference to draw to scale, three times the median; infinity if all fit."""
    sizes = np.abs([difference.mean for difference in differences])
    # Without this limit a few failing methods would make the differences of all other methods indistinguishable.
    usual = 3 * float(np.median(sizes))
    return usual if sizes.max() > usual > 0 else np.inf
