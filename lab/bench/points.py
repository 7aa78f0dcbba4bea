"""Work-precision diagrams: measured points, diagrams of points, and the setting that a diagram recommends."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

NEAR_BEST = 1.1  # a setting counts as good as the best one if its error is at most this factor times the best


@dataclass(frozen=True)
class Point:
    """Measured error and time of one setting.

    Attributes:
        curve: name of the curve to which the point belongs.
        setting: name of the setting; curve and setting together are unique within a diagram.
        x: position on the x axis if `Diagram.over` names a condition; without meaning otherwise.
        error: error in the diagram's unit; less is better.
        seconds: time that the diagram assigns to the setting: usually the CPU time of one call, for an iterate the CPU
            time from the start of the solver.
        stands: True if the setting can be recommended; False for points that are no choice, such as an earlier
            iterate.
    """

    curve: str
    setting: str
    x: float
    error: float
    seconds: float
    stands: bool = True


@dataclass(frozen=True)
class Diagram:
    """Diagram of error against time for several settings.

    Attributes:
        name: short name, also that of the file.
        title: description of what is varied.
        error: description of the error, with its unit.
        default: (curve, setting) that the project uses; None if there is nothing to choose.
        points: measured points.
        tolerance: an error of at most this factor times its baseline is not a regression.
        over: quantity on the x axis: "seconds", or the name of the varied condition if it is not a choice (such as a
            share of outliers).
        why: reasons for the default that errors and times do not show.
    """

    name: str
    title: str
    error: str
    default: tuple[str, str] | None
    points: list[Point] = field(default_factory=list)
    tolerance: float = 1.02
    over: str = "seconds"
    why: str = ""

    @property
    def curves(self) -> dict[str, list[Point]]:
        """The points by the names of their curves."""
        curves_by_name: dict[str, list[Point]] = {}
        for point in self.points:
            curves_by_name.setdefault(point.curve, []).append(point)
        return curves_by_name


def recommendation(diagram: Diagram) -> str:
    """Return a text with the fastest setting that is about as good as the best one, and a comparison with the default.

    About as good means: its error is at most `NEAR_BEST` times the smallest error. Only points that can be recommended
    (`stands`) take part. Without a default the text says that there is nothing to choose.
    """
    if diagram.default is None:
        return f"{diagram.name}: nothing to choose. {diagram.why}".strip()
    choices = [point for point in diagram.points if point.stands]
    best = min(choices, key=lambda point: point.error)
    chosen = min((p for p in choices if p.error <= NEAR_BEST * best.error), key=lambda p: p.seconds)
    default = next(p for p in diagram.points if (p.curve, p.setting) == diagram.default)
    text = (
        f"{diagram.name}: {chosen.curve} {chosen.setting}: error {chosen.error:.3g} in {1e3 * chosen.seconds:.3g} ms "
        f"(the best of all: {best.error:.3g} in {1e3 * best.seconds:.3g} ms). "
    )
    if chosen == default:
        return f"{text}It is the default. {diagram.why}".strip()
    return (
        f"{text}The default, {default.curve} {default.setting}, has {default.error:.3g} in "
        f"{1e3 * default.seconds:.3g} ms. {diagram.why}"
    ).strip()


def cpu_seconds(work: Callable[[], object], repeats: int = 3) -> float:
    """Return the least CPU seconds of `repeats` calls, summed over this process's threads.

    Other processes influence the least time least.
    """
    least = float("inf")
    for _ in range(repeats):
        began = time.process_time()
        work()
        least = min(least, time.process_time() - began)
    return least
