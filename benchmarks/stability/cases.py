"""Definition of a case, and helpers shared by all cases."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Case:
    """One stiff or extreme input, and what must hold for it.

    Attributes:
        name: what is extreme.
        quantity: what is measured, with its unit.
        bound: the largest correct value; derived beside the case.
        measure: measures it.
    """

    name: str
    quantity: str
    bound: float
    measure: Callable[[], float]


def count_unclear_refusal(call: Callable[[], object], *words: str, error: type[Exception] = ValueError) -> float:
    """0 if `call` raises `error` with all of these words in its message, else 1."""
    try:
        call()
    except error as refusal:
        return float(not all(word in str(refusal) for word in words))
    return 1.0


def nan_safe_max(*values: float) -> float:
    """The largest value; infinite if one is NaN, which `max` might ignore."""
    return math.inf if any(value != value for value in values) else float(max(values))


UNCLEAR = "refusals without the cause in the message"
EXACT = 0.0  # bound of counts, of bitwise equality, and of refusals
EPS32, EPS64 = 2.0**-24, 2.0**-53  # relative error of one rounding
