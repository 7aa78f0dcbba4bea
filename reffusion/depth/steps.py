"""Sharp steps in a depth map: pixels between two surfaces get the depth of the surface that they show."""

from __future__ import annotations

import cv2
import numpy as np

from reffusion.gaussians.surfels import one_sided_slope

# Half the side of the window in which the surfaces beside a step are found: of the image's width, and at least in px.
WINDOW, LEAST_WINDOW_PX = 0.01, 4
STEP = 0.04  # least bend of the disparity, relative to the disparity, from which a pixel lies beside a step
ON_RAMP = 0.01  # weight of a neighbour at which the depth changes as fast as at a step
COLOR = 20.0  # of 255: colour difference at which the weight of a neighbour falls to 1 / e


def sharpen_steps(depth: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Return a depth map [H, W] without ramps between a surface and the surface behind it.

    A rendering of Gaussians, and a smooth continuation, blend the depths of two surfaces along their border. A Gaussian
    at such a depth would hang in the air as a streak along the line of sight. Each pixel beside a step gets the
    weighted median of the surfaces around it, where pixels of its own colour weigh more.

    Args:
        depth: [H, W], camera z, positive.
        image: uint8 [H, W, 3], the picture of the view.
    """
    radius, disparity = _radius(depth), 1.0 / depth
    square = np.ones((3, 3), np.uint8)
    ramp = cv2.dilate(disparity, square) - cv2.erode(disparity, square) > STEP * disparity
    rows, columns = np.nonzero(beside_steps(depth))
    steps = np.arange(-radius, radius + 1)
    down, right = (each.ravel() for each in np.meshgrid(steps, steps, indexing="ij"))
    near_rows = (rows[:, None] + down).clip(0, depth.shape[0] - 1)
    near_columns = (columns[:, None] + right).clip(0, depth.shape[1] - 1)
    colors = image.astype(np.float32)
    difference = np.abs(colors[near_rows, near_columns] - colors[rows, columns][:, None]).max(-1)
    # The surface around each neighbour, continued to the pixel as a plane, whose disparity is linear.
    down_slope, right_slope = one_sided_slope(disparity), one_sided_slope(disparity.T).T
    values = disparity[near_rows, near_columns] - down_slope[near_rows, near_columns] * (near_rows - rows[:, None])
    values -= right_slope[near_rows, near_columns] * (near_columns - columns[:, None])
    weights = np.exp(-difference / COLOR)
    weights *= np.where(ramp[near_rows, near_columns], ON_RAMP, 1.0)
    order = np.argsort(values, axis=1)
    total = np.cumsum(np.take_along_axis(weights, order, 1), 1)
    middle = (total >= total[:, -1:] / 2).argmax(1)
    found = depth.copy()
    chosen = values[np.arange(len(rows)), order[np.arange(len(rows)), middle]]
    found[rows, columns] = 1.0 / chosen.clip(disparity.min(), disparity.max())
    return found


def beside_steps(depth: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the pixels beside a step of a depth map [H, W], camera z, positive.

    Steps are found in disparity, which is linear over a plane of any slant.
    """
    disparity, found = 1.0 / depth, np.zeros(depth.shape, bool)
    for reach in range(1, _radius(depth) + 1):
        for values, result in ((disparity, found), (disparity.T, found.T)):
            if len(values) > 2 * reach:
                bend = np.abs(values[: -2 * reach] - 2 * values[reach:-reach] + values[2 * reach :])
                result[reach:-reach] |= bend > STEP * values[reach:-reach]
    return found


def _radius(depth: np.ndarray) -> int:
    return max(LEAST_WINDOW_PX, round(WINDOW * depth.shape[1]))
