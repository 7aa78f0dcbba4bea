"""Stability suite: stiff and extreme inputs, each with a bound on the error (docs/development.md#measuring).

A *case* measures an error, or counts wrong results, on an extreme input. A comment beside each case derives its bound.
"""

from __future__ import annotations

import math
import sys
import traceback
from importlib import import_module
from typing import NamedTuple

from lab.stability.cases import Case

SUBJECTS = (
    "splatting",
    "random_scenes",
    "frames",
    "alignment",
    "solvers",
    "diffusion",
    "critic",
    "metric_cases",
    "optimisation",
    "splat_files",
)


class Row(NamedTuple):
    """Result of a case: one line of the table, and one object of stability.json.

    Attributes:
        case: name of the case.
        quantity: description of the measured quantity.
        bound: largest correct value.
        measured: measured value; None if the case raised an exception or gave no finite number.
        ok: True if the measured value is finite and within the bound.
    """

    case: str
    quantity: str
    bound: float
    measured: float | None
    ok: bool


def all_cases() -> list[Case]:
    """Return the cases of all subjects; their names are unique."""
    return [case for subject in SUBJECTS for case in import_module(f"lab.stability.{subject}").CASES]


def run(case: Case) -> Row:
    """Measure a case and compare the value with its bound.

    A case that raises an exception or gives no finite number fails, with None as the measured value. The traceback is
    printed.
    """
    try:
        measured = float(case.measure())
    except Exception:
        traceback.print_exc(file=sys.stderr)
        measured = math.nan
    finite = math.isfinite(measured)
    ok = finite and bool(measured <= case.bound)
    return Row(case.name, case.quantity, float(case.bound), measured if finite else None, ok)
