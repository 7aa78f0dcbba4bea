"""Things that an inpainter adds: generative ones like to put an object where one was."""

from __future__ import annotations

import cv2
import numpy as np

from reffusion.clicks.marks import Clicks
from reffusion.clicks.segmenter import Prompt, Segmenter, encode_image, predict_masks

# On 15 real photographs whose hole shows what was there, the network's score of such a segment is at most .86; with a
# thing of three fifths of the hole's height painted in, at least .98.
SCORE = 0.95  # least expected IoU of a segment that is a thing
INSIDE = 0.9  # least share of the thing's pixels in the hole: what the hole cuts goes on beyond it
SHARE = 0.12, 0.95  # of the hole's pixels that a thing covers; what covers more is the hole's whole filling
PROMPTS = 4  # places in the hole at which the network is asked
NARROW = 0.3  # places at less than this share of the hole's largest distance from its border are not asked about


def find_added_thing(segmenter: Segmenter, image: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """Find a thing of its own that a painting shows inside the hole.

    Args:
        segmenter: a promptable network.
        image: uint8 [H, W, 3], the painted view.
        hole: bool [H, W], the painted pixels, at least one.

    Returns:
        The largest such thing, bool [H, W]; False everywhere if there is none.
    """
    features, largest = encode_image(segmenter, image), np.zeros_like(hole)
    for point in _spread_points(hole):
        for each in predict_masks(segmenter, features, Prompt(Clicks(point[None], np.array([True])))):
            inside = np.count_nonzero(each.mask & hole)
            is_thing = each.score >= SCORE and inside >= INSIDE * np.count_nonzero(each.mask)
            if is_thing and SHARE[0] <= inside / np.count_nonzero(hole) <= SHARE[1]:
                largest = max(largest, each.mask, key=np.count_nonzero)
    return largest


def _spread_points(hole: np.ndarray) -> list[np.ndarray]:
    """Return up to `PROMPTS` points (x, y) in px: the middle of the hole, then of what lies beyond its circle."""
    depth = cv2.distanceTransform(np.pad(hole, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    left, points = depth.copy(), []
    while len(points) < PROMPTS and left.max() >= NARROW * depth.max():
        row, column = np.unravel_index(left.argmax(), left.shape)
        points.append(np.array([column, row]) + 0.5)
        cv2.circle(left, (int(column), int(row)), int(np.ceil(depth[row, column])), 0, -1)
    return points
