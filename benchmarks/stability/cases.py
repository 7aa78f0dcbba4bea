"""What a case is, and how cases say that something was refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Case:
    """One stiff or extreme input, and what must hold there.

    Attributes:
        name: what is extreme.
        quantity: what is measured, with its unit.
        bound: the largest value that is right; argued beside the case.
        measure: measures it.
    """

    name: str
    quantity: str
    bound: float
    measure: Callable[[], float]


def unclear(call: Callable[[], object], *words: str, error: type[Exception] = ValueError) -> float:
    """0 where `call` raises `error` with all of these words in its message, else 1."""
    try:
        call()
    except error as refusal:
        return float(not all(word in str(refusal) for word in words))
    return 1.0


def largest(*values: float) -> float:
    """The largest, infinite where one is not a number (which `max` might pass over)."""
    return math.inf if any(value != value for value in values) else float(max(values))


UNCLEAR = "refusals without the cause in the message"
EXACT = 0.0  # bound of counts, of what must agree bit for bit, and of what is refused
EPS32, EPS64 = 2.0**-24, 2.0**-53  # relative error of one rounding
