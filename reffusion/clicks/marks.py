"""Clicks on a photograph, and the pixels that they mark."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

OBJECT, OTHER, UNKNOWN = 1, -1, 0


@dataclass(frozen=True)
class Clicks:
    """Clicks on a view in the order in which they were made; a scribble is many clicks.

    Attributes:
        points: [K, 2] float64, pixels of the view, as in docs/architecture.md.
        positive: [K] bool, True = on the object, False = on the background.
    """

    points: np.ndarray
    positive: np.ndarray

    def __len__(self) -> int:
        return len(self.points)


def mark_pixels(clicks: Clicks, shape: tuple[int, int]) -> np.ndarray:
    """int8 [H, W], OBJECT, OTHER or UNKNOWN. Only the clicked pixels are marked, since a click may be next to the
    object's border; the later click wins."""
    found = np.full(shape, UNKNOWN, np.int8)
    columns, rows = (clicks.points[:, axis].astype(int).clip(0, shape[1 - axis] - 1) for axis in (0, 1))
    for column, row, positive in zip(columns, rows, clicks.positive, strict=True):
        found[row, column] = OBJECT if positive else OTHER
    return found
