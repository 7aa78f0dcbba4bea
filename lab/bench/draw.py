"""Charts of the work-precision diagrams, which show the error against the time."""

from __future__ import annotations

from pathlib import Path

from lab.bench.points import Diagram
from report import charts


def draw(diagram: Diagram, path: Path) -> None:
    """Draw the error against the time, one line per curve; write a PNG.

    Settings that can be recommended are named beside their points, and the default is ringed. If `diagram.over` names a
    condition instead of "seconds", two panels show the error and the time against this condition, without names.

    Args:
        diagram: what to draw.
        path: PNG to write.
    """
    against_time = diagram.over == "seconds"
    figure, grid = charts.new_figure(4.6, 1, 1 if against_time else 2)
    long = against_time and min(p.seconds for p in diagram.points) > 10
    scale, work = (1.0, "seconds") if long else (1e3, "milliseconds of CPU")
    axes = grid[0, 0]
    for curve, points in diagram.curves.items():
        across = [scale * p.seconds if against_time else p.x for p in points]
        axes.plot(across, [p.error for p in points], marker=".", label=curve)
        if not against_time:
            grid[0, 1].plot(across, [1e3 * p.seconds for p in points], marker=".", label=curve)
        for x, point in zip(across, points, strict=True):
            if against_time and point.stands:
                axes.annotate(point.setting, (x, point.error), textcoords="offset points", xytext=(4, 4), fontsize=7)
            if (point.curve, point.setting) == diagram.default:
                axes.scatter([x], [point.error], s=120, facecolors="none", edgecolors="black", label="default")
    axes.set(yscale="log", ylabel=diagram.error, xlabel=work if against_time else diagram.over)
    if against_time or min(p.x for p in diagram.points) > 0:
        axes.set_xscale("log")
    if not against_time:
        grid[0, 1].set(xlabel=diagram.over, ylabel="milliseconds of CPU", xscale=axes.get_xscale(), yscale="log")
    axes.legend(fontsize=8)
    figure.suptitle(diagram.title, fontsize=10)
    charts.save_chart(figure, path)
