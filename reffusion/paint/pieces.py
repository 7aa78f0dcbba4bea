"""Pictures completed from pieces of themselves."""

from __future__ import annotations

import cv2
import numpy as np

from reffusion.paint import shiftmap
from reffusion.paint.paint2d import blanked, inside, telea


def exemplar(image: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """OpenCV's shift maps (after He and Sun, Statistics of Patch Offsets for Image Completion, 2012): the hole is put
    together from pieces of the picture moved by the offsets at which it resembles itself most. As sharp as the
    picture; it repeats what is there and invents nothing. Pixels that no offset reaches are filled by `telea`.

    Raises:
        ValueError: this OpenCV has no xphoto module.
    """
    if not hole.any():  # OpenCV would crash
        return image.copy()
    if not hasattr(cv2, "xphoto"):
        raise ValueError("this OpenCV has no xphoto module; `pip install opencv-contrib-python-headless`")
    near = _context(hole)  # time grows with the picture, and what is far away is seldom alike
    known = np.where(hole, 0, 255).astype(np.uint8)
    lab = cv2.cvtColor(blanked(image, hole), cv2.COLOR_RGB2Lab)
    painted = np.zeros_like(lab)
    painted[near] = shiftmap.completed(lab[near], known[near])
    unreached = hole & ~painted.any(2)  # zeros are no colour: grey has a = b = 128
    picture = inside(image, cv2.cvtColor(painted, cv2.COLOR_Lab2RGB), hole)
    return telea(picture, unreached) if unreached.any() else picture


def _context(hole: np.ndarray) -> tuple[slice, slice]:
    """The rows and columns of the hole's box and as much again to every side, of the picture's quarter at least."""
    spans = [np.flatnonzero(hole.any(axis)) for axis in (1, 0)]
    sides = [span[-1] + 1 - span[0] for span in spans]
    reach = max(*sides, max(hole.shape) // 4)
    return tuple(slice(max(span[0] - reach, 0), span[-1] + 1 + reach) for span in spans)
