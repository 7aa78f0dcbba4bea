"""Masks with a margin, and their hulls."""

from __future__ import annotations

import cv2
import numpy as np


def widened(mask: np.ndarray, fraction: float) -> np.ndarray:
    """The mask, bool [H, W], and all pixels within `fraction` of the image's width. At the rim of a mask the object's
    blurred edge remains, and an inpainter would continue it into the hole."""
    reach = round(fraction * mask.shape[1])
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return cv2.dilate(mask.astype(np.uint8), disk) > 0


def hull(mask: np.ndarray) -> np.ndarray:
    """bool [H, W], the convex hull of a mask's pixels: what is seen of a surface goes on as far as the straight
    prolongations of its borders."""
    rows, columns = np.nonzero(mask)
    found = np.zeros(mask.shape, np.uint8)
    if len(rows):
        cv2.fillConvexPoly(found, cv2.convexHull(np.stack([columns, rows], 1).astype(np.int32)), 1)
    return found > 0
