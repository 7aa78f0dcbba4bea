"""Comparison of the diagrams with recorded baselines.

Errors have a tight tolerance. Times have a loose one and are divided by the time of a fixed computation, the *machine
unit*, so that baselines hold on machines of other speed too.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lab.bench.points import Diagram, cpu_seconds

SLOWER = 2.0  # allowed factor on a baseline's time in machine units; repeats on one machine differ by up to 1.6
LEAST_SECONDS = 2e-3  # differences of time below this are noise
LEAST_ERROR = 1e-9  # differences of errors below this are ignored


def machine_unit() -> float:
    """Return the CPU seconds of a fixed computation with arithmetic and memory work, by which times are divided."""
    random = np.random.default_rng(0)
    square, long = random.standard_normal((300, 300)), random.standard_normal(300_000)

    def work() -> None:
        for _ in range(4):
            np.sort(long)
            square @ square
            np.exp(long).cumsum()

    return cpu_seconds(work, repeats=7)


def baseline_table(diagrams: list[Diagram], unit: float) -> dict[str, Any]:
    """Return the content of a file of baselines.

    Args:
        diagrams: measured diagrams.
        unit: the machine unit, seconds.

    Returns:
        "machine_unit", and "diagrams": name of a diagram -> {"curve, setting": [error, seconds]}.
    """
    points = {d.name: {f"{p.curve}, {p.setting}": [p.error, p.seconds] for p in d.points} for d in diagrams}
    return {"machine_unit": unit, "diagrams": points}


def regressions(diagrams: list[Diagram], unit: float, baselines: dict[str, Any]) -> list[str]:
    """Compare measured diagrams with baselines.

    Args:
        diagrams: measured diagrams.
        unit: the machine unit of this machine, seconds.
        baselines: result of `load`.

    Returns:
        Lines of text, empty if all is well. There is one for each error above `tolerance` times its baseline plus
        `LEAST_ERROR`, for each time above `SLOWER` times its baseline (in machine units) plus `LEAST_SECONDS`, for each
        measured point or whole diagram without a baseline, and for each baseline of a measured diagram whose point was
        not measured. Diagrams that were not measured are not compared.
    """
    lines, pace = [], unit / baselines["machine_unit"]
    for diagram in diagrams:
        if diagram.name not in baselines["diagrams"]:
            lines.append(f"{diagram.name}: no baseline; write one with --write-baselines")
            continue
        known = dict(baselines["diagrams"][diagram.name])
        for point in diagram.points:
            name = f"{point.curve}, {point.setting}"
            if name not in known:
                lines.append(f"{diagram.name}: {name}: no baseline; write one with --write-baselines")
                continue
            error, seconds = known.pop(name)
            if point.error > diagram.tolerance * error + LEAST_ERROR:
                lines.append(f"{diagram.name}: {name}: error {point.error:.4g}, baseline {error:.4g}")
            if point.seconds > SLOWER * pace * seconds + LEAST_SECONDS:
                lines.append(
                    f"{diagram.name}: {name}: {1e3 * point.seconds:.3g} ms, baseline {1e3 * pace * seconds:.3g} ms "
                    "at this machine's speed"
                )
        lines += [f"{diagram.name}: {name}: is in the baselines and was not measured" for name in known]
    return lines


def take_faster(diagram: Diagram, repeated: Diagram) -> Diagram:
    """Return a diagram with the shorter of two measured times at each point.

    Args:
        diagram: first measurement, whose errors are kept.
        repeated: second measurement of the same points.
    """
    seconds = {(p.curve, p.setting): p.seconds for p in repeated.points}
    points = [replace(p, seconds=min(p.seconds, seconds[p.curve, p.setting])) for p in diagram.points]
    return replace(diagram, points=points)


def load(path: Path) -> dict[str, Any]:
    """Load a file of baselines.

    Raises:
        ValueError: the file is missing.
    """
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise ValueError(f"{path}: no baselines; write them with --write-baselines") from None
