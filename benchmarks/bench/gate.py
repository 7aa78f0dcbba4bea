"""Baselines of the diagrams: errors have a tight tolerance, times a loose one in units of the machine's speed."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bench.points import Diagram, cpu_seconds

SLOWER = 2.0  # allowed factor on a baseline's time, in machine units; repeats on one machine differ by up to 1.6
LEAST_SECONDS = 2e-3  # smaller differences are noise
LEAST_ERROR = 1e-9


def machine_unit() -> float:
    """CPU seconds of a fixed piece of arithmetic and memory work, by which times are divided."""
    random = np.random.default_rng(0)
    square, long = random.standard_normal((300, 300)), random.standard_normal(300_000)

    def work() -> None:
        for _ in range(4):
            np.sort(long)
            square @ square
            np.exp(long).cumsum()

    return cpu_seconds(work, repeats=7)


def baseline_table(diagrams: list[Diagram], unit: float) -> dict[str, Any]:
    """Content of a baseline file: name -> {"curve, setting": [error, seconds]}."""
    points = {d.name: {f"{p.curve}, {p.setting}": [p.error, p.seconds] for p in d.points} for d in diagrams}
    return {"machine_unit": unit, "diagrams": points}


def regressions(diagrams: list[Diagram], unit: float, baselines: dict[str, Any]) -> list[str]:
    """One line for each point that is worse than its baseline, or exists on one side only."""
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
    """The diagram with the shorter of two measured times at each point, and the errors of the first."""
    seconds = {(p.curve, p.setting): p.seconds for p in repeated.points}
    points = [replace(p, seconds=min(p.seconds, seconds[p.curve, p.setting])) for p in diagram.points]
    return replace(diagram, points=points)


def load(path: Path) -> dict[str, Any]:
    """Load baselines. ValueError if the file is missing."""
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise ValueError(f"{path}: no baselines; write them with --write-baselines") from None
