"""Masks with a margin."""

from __future__ import annotations

import cv2
import numpy as np


def widened(mask: np.ndarray, fraction: float) -> np.ndarray:
    """The mask, bool [H, W], and all pixels within `fraction` of the image's width. At the rim of a mask the object's
    blurred edge remains, and an inpainter would continue it into the hole."""
    reach = round(fraction * mask.shape[1])
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return cv2.dilate(mask.astype(np.uint8), disk) > 0
