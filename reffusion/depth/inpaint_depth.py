"""A quick completion of depth maps, for decisions that need no accuracy."""

from __future__ import annotations

import cv2
import numpy as np


def inpaint_depth(depth: np.ndarray, known: np.ndarray) -> np.ndarray:
    """[H, W] depth whose unknown pixels continue the disparity around them (Telea); 0 where that is about infinity.

    Args:
        known: bool [H, W], pixels whose depth is kept.
    """
    disparity = np.where(known, 1 / np.where(known, depth, 1.0), 0.0)
    top = max(float(disparity.max()), 1e-12)
    levels = np.round(disparity / top * 65535).astype(np.uint16)
    filled = cv2.inpaint(levels, (~known).astype(np.uint8), 3, cv2.INPAINT_TELEA) / 65535 * top
    filled = np.where(known, disparity, filled)
    return np.divide(1.0, filled, out=np.zeros_like(filled), where=filled > 1e-3 * top)
