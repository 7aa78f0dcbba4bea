"""A measured point, a diagram of points, and the setting that a diagram recommends."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

NEAR_BEST = 1.1  # a setting is as good as the best if its error is within this factor


@dataclass(frozen=True)
class Point:
    """One setting of one curve.

    Attributes:
        curve, setting: names; together unique within a diagram.
        x: the setting as a number, if it is one.
        error: in the diagram's unit; less is better.
        seconds: CPU time of one call.
        stands: whether it can be recommended; False for points that are no choice, such as an earlier iterate.
    """

    curve: str
    setting: str
    x: float
    error: float
    seconds: float
    stands: bool = True


@dataclass(frozen=True)
class Diagram:
    """Error against work.

    Attributes:
        name: short, also of the file.
        title, error: what is varied, and what the error is, with its unit.
        default: (curve, setting) that the project uses; None if there is no choice.
        points: measured.
        tolerance: factor on a baseline's error that is not yet a regression.
        over: the x axis: "seconds", or the name of the setting if it is a condition and not a choice.
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
        curves_by_name: dict[str, list[Point]] = {}
        for point in self.points:
            curves_by_name.setdefault(point.curve, []).append(point)
        return curves_by_name


def recommendation(diagram: Diagram) -> str:
    """The cheapest setting that is as good as the best, and how the default compares."""
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
    """Least CPU time of a few calls, so that other processes count little."""
    least = float("inf")
    for _ in range(repeats):
        began = time.process_time()
        work()
        least = min(least, time.process_time() - began)
    return least
