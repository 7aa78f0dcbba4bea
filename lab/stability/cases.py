"""Definition of a case of the stability suite, and helpers shared by all cases."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Case:
    """Stiff or extreme input, and the bound that must hold for it.

    Attributes:
        name: description of the extreme input.
        quantity: description of the measured quantity, with its unit.
        bound: largest correct value of the quantity; a comment beside the case derives it.
        measure: function that measures the quantity.
    """

    name: str
    quantity: str
    bound: float
    measure: Callable[[], float]


def count_unclear_refusal(call: Callable[[], object], *words: str, error: type[Exception] = ValueError) -> float:
    """Return 0 if `call` raises the exception `error` with all of `words` in its message, else 1.

    Exceptions of other types are not caught.
    """
    try:
        call()
    except error as refusal:
        return float(not all(word in str(refusal) for word in words))
    return 1.0


def nan_safe_max(*values: float) -> float:
    """Return the largest value, or infinity if a value is NaN, which `max` might ignore."""
    return math.inf if any(value != value for value in values) else float(max(values))


UNCLEAR = "refusals without the cause in the message"
EXACT = 0.0  # bound of counts, of bitwise equality, and of refusals
EPS32, EPS64 = 2.0**-24, 2.0**-53  # relative error of one rounding
