"""Binary morphology of masks, bool [H, W].

Most sizes are given as fractions of the image's width, so that they fit pictures of any resolution.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

ISLAND, GAP = 0.01, 0.02  # of the image's width: usual sizes below which islands are removed, and holes filled


def to_pixels(fraction: float, width: int) -> int:
    """Convert a fraction of the image's width to pixels, rounded, at least 1."""
    return max(1, round(fraction * width))


def disk(radius: int) -> np.ndarray:
    """Return the structuring element of a disk, uint8 [2 radius + 1, 2 radius + 1], 1 inside; the radius is in px."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def square(radius: int) -> np.ndarray:
    """Return the structuring element of a square, uint8 ones [2 radius + 1, 2 radius + 1]; the radius is in px."""
    return np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)


def dilate(mask: np.ndarray, fraction: float) -> np.ndarray:
    """Dilate a mask, bool [H, W], by a disk.

    Args:
        fraction: radius of the disk as a fraction of the image's width. A radius below one pixel is raised to one
            pixel; with 0 the mask is returned as it is.
    """
    if not fraction:
        return mask
    return cv2.dilate(mask.astype(np.uint8), disk(to_pixels(fraction, mask.shape[1]))) > 0


def dilate_square(mask: np.ndarray, radius: int) -> np.ndarray:
    """Dilate a mask, bool [H, W], by a square; the radius is in px."""
    return cv2.dilate(mask.astype(np.uint8), square(radius)) > 0


def dilate_by_distance(mask: np.ndarray, fraction: float) -> np.ndarray:
    """Dilate a mask, bool [H, W], by an exact Euclidean distance.

    Unlike `dilate`, this function takes the same time for any radius, so it suits large radii.

    Args:
        fraction: the distance as a fraction of the image's width. The distance is not rounded to whole pixels, so a
            distance below one pixel leaves the mask as it is.
    """
    if not mask.any():
        return mask
    return ndimage.distance_transform_edt(~mask) <= fraction * mask.shape[1]


def open_mask(mask: np.ndarray, fraction: float) -> np.ndarray:
    """Remove the parts of a mask, bool [H, W], into which a disk does not fit (morphological opening).

    Beyond the image's border the mask continues with the values at the border.

    Args:
        fraction: radius of the disk as a fraction of the image's width, at least one pixel.
    """
    radius = to_pixels(fraction, mask.shape[1])
    padded = np.pad(mask.astype(np.uint8), radius, mode="edge")
    return cv2.morphologyEx(padded, cv2.MORPH_OPEN, disk(radius))[radius:-radius, radius:-radius] > 0


def close_mask(mask: np.ndarray, fraction: float) -> np.ndarray:
    """Fill the gaps of a mask, bool [H, W], into which a disk does not fit (morphological closing).

    Beyond the image's border the mask is False.

    Args:
        fraction: radius of the disk as a fraction of the image's width, at least one pixel.
    """
    radius = to_pixels(fraction, mask.shape[1])
    padded = np.pad(mask.astype(np.uint8), radius)
    return cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disk(radius))[radius:-radius, radius:-radius] > 0


def remove_slivers(mask: np.ndarray, fraction: float) -> np.ndarray:
    """Remove slivers from a mask, bool [H, W]: smooth it by a majority vote in a square window, then open it.

    Slivers arise along depth edges. The vote also adds pixels, e.g. in narrow gaps of the mask.

    Args:
        fraction: half of the least width of the parts that remain, as a fraction of the image's width, at least one
            pixel. This is half of the window's side, and the radius of the disk of the opening.
    """
    side = 2 * to_pixels(fraction, mask.shape[1]) + 1
    majority = cv2.blur(mask.astype(np.float32), (side, side), borderType=cv2.BORDER_REPLICATE) > 0.5
    return open_mask(majority, fraction)


def remove_small_parts(mask: np.ndarray, island_px: float, gap_px: float) -> np.ndarray:
    """Remove small islands from a mask, bool [H, W], then fill small holes.

    Islands and holes are parts that are connected horizontally or vertically. Background that touches the image's
    border is a hole, too.

    Args:
        island_px: islands of a smaller area than a disk of this diameter, in pixels, are removed.
        gap_px: holes of a smaller area than a disk of this diameter, in pixels, are filled.
    """
    kept = mask & ~_small_parts(mask, island_px)
    return kept | _small_parts(~kept, gap_px)


def _small_parts(mask: np.ndarray, diameter_px: float) -> np.ndarray:
    """Return bool [H, W], the connected parts of the mask with a smaller area than a disk of this diameter."""
    parts, sizes = label_sizes(mask)
    return mask & (sizes < np.pi / 4 * diameter_px**2)[parts]


def label_sizes(mask: np.ndarray, structure: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the connected parts of a mask, bool [H, W], as labels 1, 2, ..., and the number of pixels of each label.

    Args:
        structure: bool [3, 3], which of the pixels around a pixel are connected with it; None for horizontal and
            vertical neighbors.

    Returns:
        int [H, W], the labels, 0 outside the mask; and int [K + 1], the sizes. The size of the label 0 is 0.
    """
    parts, _ = ndimage.label(mask, structure)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return parts, sizes


def nearest_known(known: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return row and column of the True pixel that is nearest to each pixel, int [H, W] both, as an index.

    Args:
        known: bool [H, W], with at least one True pixel.
    """
    return tuple(ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True))


def masked_blur(values: np.ndarray, known: np.ndarray, sigma: float) -> np.ndarray:
    """Return values, float32 [H, W, C], blurred by a Gaussian over the pixels `known`, bool [H, W], alone.

    Args:
        sigma: standard deviation of the Gaussian in px.
    """
    weight = known.astype(np.float32)
    blur = lambda each: cv2.GaussianBlur(each, (0, 0), sigma)
    return blur(values * weight[..., None]) / np.maximum(blur(weight), 1e-3)[..., None]


def touches_border(mask: np.ndarray) -> bool:
    """Return whether a mask, bool [H, W], has a True pixel at the image's border."""
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())


def convex_hull(mask: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the convex hull of the mask's pixels; empty if the mask is empty."""
    rows, columns = np.nonzero(mask)
    found = np.zeros(mask.shape, np.uint8)
    if len(rows):
        cv2.fillConvexPoly(found, cv2.convexHull(np.stack([columns, rows], 1).astype(np.int32)), 1)
    return found > 0
