"""The reduced picture that clicks segment: colors, pairs of neighboring pixels, edges between surfaces."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from reffusion.clicks.marks import Clicks, mark_pixels
from reffusion.graph_cut import neighbor_pairs
from reffusion.io.images import fitting_size

LONGEST = 192  # px, the larger side of the picture that is segmented
# Slope of the relief (`ViewEvidence.relief`) in px per px: the largest within a surface, and the smallest of a certain
# edge between two surfaces.
DEPTH_SLOPE = 4.0, 10.0


def downscale(image: np.ndarray, clicks: Clicks) -> tuple[np.ndarray, tuple[int, int], np.ndarray]:
    """Reduce a picture and its clicks to the size for segmentation, at most `LONGEST` px on the larger side.

    Returns:
        Colors float64 [h * w, 3] in 8-bit L*a*b*; (h, w); marks int8 [h, w], OBJECT, OTHER or UNKNOWN.
    """
    width, height = fitting_size(image.shape[1], image.shape[0], LONGEST)
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB).reshape(-1, 3).astype(np.float64)
    at = Clicks(clicks.points * (width / image.shape[1], height / image.shape[0]), clicks.positive)
    return lab, (height, width), mark_pixels(at, (height, width))


def upscale(mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return bool [H, W], a mask of the reduced picture, bool [h, w], at the size `shape` = (H, W)."""
    return cv2.resize(mask.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5


def pixel_pairs(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return `neighbor_pairs` of a picture of (height, width), whose pixels are numbered row by row."""
    return neighbor_pairs(np.arange(shape[0] * shape[1]).reshape(shape))


def find_depth_edges(
    relief: np.ndarray | None, small: tuple[int, int], pairs: np.ndarray, length: np.ndarray
) -> np.ndarray | None:
    """Return [E] in [0, 1], how surely the two pixels of a pair lie on different surfaces, one behind the other.

    Args:
        relief: float [H, W] as in `ViewEvidence`; None if the scene is not fitted yet, and then the result is None.
        small: (h, w), the size for segmentation.
        pairs: int [E, 2], neighboring pixels at this size.
        length: [E], their distances in pixels.
    """
    if relief is None:
        return None
    size = small[::-1]
    seen = cv2.resize(relief.astype(np.float32), size, interpolation=cv2.INTER_AREA) * (size[0] / relief.shape[1])
    seen = cv2.medianBlur(seen, 3).ravel()
    slope = np.abs(seen[pairs[:, 0]] - seen[pairs[:, 1]]) / length
    return ((slope - DEPTH_SLOPE[0]) / (DEPTH_SLOPE[1] - DEPTH_SLOPE[0])).clip(0, 1)


def value_at(mask: np.ndarray, at: np.ndarray) -> bool:
    """Return the value of a mask, bool [H, W], at (x, y) = `at` in pixels; outside the picture, at its border."""
    return bool(mask[_pixel_at(mask, at)])


def part_at(mask: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the connected part (8-neighborhood) of a mask that contains a point.

    The result is all False if the mask is False at the point.

    Args:
        at: (x, y) in pixels, see `value_at`.
    """
    if not value_at(mask, at):
        return np.zeros_like(mask)
    parts, _ = ndimage.label(mask, np.ones((3, 3)))
    return parts == parts[_pixel_at(mask, at)]


def _pixel_at(mask: np.ndarray, at: np.ndarray) -> tuple[int, int]:
    """Return (row, column) of the pixel of a mask that is nearest to the point `at` = (x, y)."""
    row, column = (int(min(max(at[axis], 0), mask.shape[1 - axis] - 1)) for axis in (1, 0))
    return row, column
