"""Clicks, boxes and brush strokes on a photograph, and the pixels that they mark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

OBJECT, OTHER, UNKNOWN = 1, -1, 0  # values of a pixel: marked as object, marked as background, not marked
SIZES = "small", "middle", "large"  # values of `Mark.size`
_SHIFT = 4  # fractional bits of the coordinates that OpenCV gets when strokes are painted


@dataclass(frozen=True)
class Clicks:
    """Clicks on a view in the order in which they were made.

    Attributes:
        points: float64 [K, 2], (x, y) in pixels of the view; the first pixel's center is (0.5, 0.5).
        positive: bool [K], True = on the object, False = on the background.
    """

    points: np.ndarray
    positive: np.ndarray

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class Mark:
    """A click, a box or a brush stroke on a view.

    A click adds a whole region to the mask or removes one. A box does so with the thing that it encloses. A stroke
    changes only the pixels that the brush covers.

    Attributes:
        points: float64 [K, 2], (x, y) in pixels of the view: the position of a click (K = 1), two opposite corners of a
            box (K = 2 without a radius), or the path of a stroke.
        positive: True = on the object, False = on the background.
        radius: px, radius of the brush; 0 for a click and a box.
        size: which of the proposed regions a click or a box takes, one of `SIZES`; "" for the most probable one.
    """

    points: np.ndarray
    positive: bool
    radius: float = 0.0
    size: str = ""

    @property
    def is_click(self) -> bool:
        """Whether the mark is a click, neither a box nor a stroke."""
        return not self.radius and len(self.points) == 1

    @property
    def is_box(self) -> bool:
        """Whether the mark is a box."""
        return not self.radius and len(self.points) == 2

    @property
    def box(self) -> tuple[float, float, float, float]:
        """(left, top, right, bottom) of the mark's points, px."""
        (left, top), (right, bottom) = self.points.min(0).tolist(), self.points.max(0).tolist()
        return left, top, right, bottom


def clicks_of(marks: Sequence[Mark]) -> Clicks:
    """Return the clicks among marks, without the boxes and the strokes."""
    clicks = [mark for mark in marks if mark.is_click]
    points = np.concatenate([np.zeros((0, 2)), *(mark.points for mark in clicks)])
    return Clicks(points, np.array([mark.positive for mark in clicks], bool))


def mark_pixels(clicks: Clicks, shape: tuple[int, int]) -> np.ndarray:
    """Return int8 [H, W] with OBJECT or OTHER at the clicked pixels, and UNKNOWN at all other pixels.

    Only the clicked pixel itself is marked, because a click may lie next to the object's border. Of two clicks on one
    pixel the later one counts. Clicks outside the image mark the nearest pixel of its border.

    Args:
        shape: (H, W).
    """
    found = np.full(shape, UNKNOWN, np.int8)
    columns, rows = (clicks.points[:, axis].astype(int).clip(0, shape[1 - axis] - 1) for axis in (0, 1))
    for column, row, positive in zip(columns, rows, clicks.positive, strict=True):
        found[row, column] = OBJECT if positive else OTHER
    return found


def confirmed_pixels(marks: Sequence[Mark], shape: tuple[int, int]) -> np.ndarray:
    """Return int8 [H, W] with OBJECT or OTHER at the pixels of clicks and below strokes, and UNKNOWN elsewhere.

    A box confirms no pixel, because it also encloses what is not meant. Where marks overlap, the later one counts.

    Args:
        shape: (H, W).
    """
    found = np.full(shape, UNKNOWN, np.int8)
    for mark in marks:
        sign = OBJECT if mark.positive else OTHER
        if mark.radius:
            found[stroke_pixels(mark, shape)] = sign
        elif mark.is_click:
            clicked = mark_pixels(clicks_of([mark]), shape)
            found[clicked != UNKNOWN] = sign
    return found


def stroke_pixels(stroke: Mark, shape: tuple[int, int]) -> np.ndarray:
    """Return bool [H, W], the pixels whose centers lie within the brush's radius of the stroke's path.

    Args:
        shape: (H, W).
    """
    painted, scale = np.zeros(shape, np.uint8), 2**_SHIFT
    path = np.round((stroke.points - 0.5) * scale).astype(np.int32)
    for point in path:
        cv2.circle(painted, point.tolist(), round(stroke.radius * scale), 1, -1, shift=_SHIFT)
    width = max(1, round(2 * stroke.radius))
    cv2.polylines(painted, [path.reshape(-1, 1, 2)], False, 1, width, shift=_SHIFT)
    return painted > 0
