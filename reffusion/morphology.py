"""Binary morphology of masks: sizes are fractions of the image's width, so that they fit pictures of any resolution."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage


def to_pixels(fraction: float, width: int) -> int:
    """A fraction of the image's width in pixels, at least 1."""
    return max(1, round(fraction * width))


def disk(radius: int) -> np.ndarray:
    """The structuring element of a disk, uint8 [2 radius + 1, 2 radius + 1]."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def square(radius: int) -> np.ndarray:
    """The structuring element of a square, uint8 [2 radius + 1, 2 radius + 1]."""
    return np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)


def dilate(mask: np.ndarray, fraction: float) -> np.ndarray:
    """The mask, bool [H, W], dilated by a disk whose radius is `fraction` of the image's width: at least one pixel,
    unless it is 0."""
    if not fraction:
        return mask
    return cv2.dilate(mask.astype(np.uint8), disk(to_pixels(fraction, mask.shape[1]))) > 0


def dilate_by_distance(mask: np.ndarray, fraction: float) -> np.ndarray:
    """The mask, bool [H, W], and all pixels within `fraction` of the image's width of it, by exact Euclidean distance.

    For large radii: unlike that of `dilate`, its cost does not grow with the radius.
    """
    if not mask.any():
        return mask
    return ndimage.distance_transform_edt(~mask) <= fraction * mask.shape[1]


def open_mask(mask: np.ndarray, fraction: float) -> np.ndarray:
    """The mask, bool [H, W], without parts that are narrower than a disk of this radius; beyond the image's border the
    mask continues as at the border."""
    radius = to_pixels(fraction, mask.shape[1])
    padded = np.pad(mask.astype(np.uint8), radius, mode="edge")
    return cv2.morphologyEx(padded, cv2.MORPH_OPEN, disk(radius))[radius:-radius, radius:-radius] > 0


def close_mask(mask: np.ndarray, fraction: float) -> np.ndarray:
    """The mask, bool [H, W], with gaps closed that are narrower than a disk of this radius."""
    radius = to_pixels(fraction, mask.shape[1])
    padded = np.pad(mask.astype(np.uint8), radius)
    return cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disk(radius))[radius:-radius, radius:-radius] > 0


def remove_slivers(mask: np.ndarray, fraction: float) -> np.ndarray:
    """The mask, bool [H, W], smoothed by a majority vote in a box, without parts narrower than twice `fraction` of the
    image's width. Depth edges leave such slivers."""
    side = 2 * to_pixels(fraction, mask.shape[1]) + 1
    majority = cv2.blur(mask.astype(np.float32), (side, side), borderType=cv2.BORDER_REPLICATE) > 0.5
    return open_mask(majority, fraction)


def remove_small_parts(mask: np.ndarray, island_px: float, gap_px: float) -> np.ndarray:
    """The mask without islands smaller than a disk of diameter `island_px`, and with holes smaller than `gap_px`
    filled."""
    kept = mask & ~_small_parts(mask, island_px)
    return kept | _small_parts(~kept, gap_px)


def _small_parts(mask: np.ndarray, diameter_px: float) -> np.ndarray:
    parts, count = ndimage.label(mask)
    area = np.bincount(parts.ravel(), minlength=count + 1)
    small = area < np.pi / 4 * diameter_px**2
    small[0] = False
    return small[parts]


def convex_hull(mask: np.ndarray) -> np.ndarray:
    """bool [H, W]: the convex hull of the mask's pixels."""
    rows, columns = np.nonzero(mask)
    found = np.zeros(mask.shape, np.uint8)
    if len(rows):
        cv2.fillConvexPoly(found, cv2.convexHull(np.stack([columns, rows], 1).astype(np.int32)), 1)
    return found > 0
