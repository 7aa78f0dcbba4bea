"""Stiff and extreme cases, each with a bound that is derived beside it (docs/development.md#measuring)."""

from __future__ import annotations

import math
import sys
import traceback
from importlib import import_module
from typing import NamedTuple

from benchmarks.stability.cases import Case

SUBJECTS = (
    "splatting",
    "random_scenes",
    "frames",
    "alignment",
    "solvers",
    "diffusion",
    "metric_cases",
    "optimisation",
    "splat_files",
)


class Row(NamedTuple):
    """One line of the table, and one object of stability.json."""

    case: str
    quantity: str
    bound: float
    measured: float | None
    ok: bool


def all_cases() -> list[Case]:
    """The cases of all subjects; names are unique."""
    return [case for subject in SUBJECTS for case in import_module(f"benchmarks.stability.{subject}").CASES]


def run(case: Case) -> Row:
    """Measure a case; `measured` is None, and the case fails, if it raised or gave no finite number."""
    try:
        measured = float(case.measure())
    except Exception:
        traceback.print_exc(file=sys.stderr)
        measured = math.nan
    finite = math.isfinite(measured)
    ok = finite and bool(measured <= case.bound)
    return Row(case.name, case.quantity, float(case.bound), measured if finite else None, ok)
