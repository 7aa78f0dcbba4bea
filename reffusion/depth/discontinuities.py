"""Sharp steps in a depth map: pixels between two surfaces get the depth of the surface that they show."""

from __future__ import annotations

import cv2
import numpy as np

from reffusion.gaussians.surfels import one_sided_slope

# Half the side of the window in which the surfaces beside a step are found: of the image's width, and at least in px.
WINDOW, LEAST_WINDOW_PX = 0.01, 4
STEP = 0.04  # least bend of the disparity, relative to the disparity, from which a pixel lies beside a step
ON_RAMP = 0.01  # weight of a neighbor at which the depth changes as fast as at a step
SAMPLES = 9  # number of rows, and of columns, of the window that are used
CHUNK = 2**16  # number of pixels that are computed together
COLOR = 20.0  # of 255: color difference at which the weight of a neighbor falls to 1 / e


def sharpen_steps(depth: np.ndarray, image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return a copy of a depth map [H, W] without ramps between a surface and the surface behind it.

    A rendering of Gaussians, and a smooth continuation, blend the depths of two surfaces along their border. A Gaussian
    at such a depth would hang in the air as a streak along the line of sight. Each pixel beside a step gets the
    weighted median of the surfaces around it, where pixels of its own color weigh more.

    Args:
        depth: [H, W], camera z, positive.
        image: uint8 [H, W, 3], the picture of the view.
        pixels: bool [H, W], the pixels whose depth may change.
    """
    disparity, colors = 1.0 / depth, image.astype(np.float32)
    square = np.ones((3, 3), np.uint8)
    ramp = cv2.dilate(disparity, square) - cv2.erode(disparity, square) > STEP * disparity
    slopes = one_sided_slope(disparity), one_sided_slope(disparity.T).T
    steps = np.linspace(-_radius(depth), _radius(depth), SAMPLES).round().astype(int)
    offsets = np.stack(np.meshgrid(steps, steps, indexing="ij"), -1).reshape(-1, 2)
    found, limits = depth.copy(), (disparity.min(), disparity.max())
    places = np.argwhere(beside_steps(depth) & pixels)
    for first in range(0, len(places), CHUNK):
        place = places[first : first + CHUNK]
        near = (place[:, None] + offsets).clip(0, np.array(depth.shape) - 1)
        moved = np.moveaxis(place[:, None] - near, -1, 0)
        at, near = tuple(place.T), tuple(np.moveaxis(near, -1, 0))
        # The surface around each neighbor, continued to the pixel as a plane, whose disparity is linear.
        values = disparity[near] + slopes[0][near] * moved[0] + slopes[1][near] * moved[1]
        difference = np.abs(colors[near] - colors[at][:, None]).max(-1)
        weights = np.exp(-difference / COLOR) * np.where(ramp[near], ON_RAMP, 1.0)
        found[at] = 1.0 / weighted_median(values, weights).clip(*limits)
    return found


def weighted_median(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return [N], the weighted median of each row of values [N, S], with positive weights [N, S]."""
    order = np.argsort(values, axis=1)
    total = np.cumsum(np.take_along_axis(weights, order, 1), 1)
    middle = (total >= total[:, -1:] / 2).argmax(1)[:, None]
    return np.take_along_axis(values, np.take_along_axis(order, middle, 1), 1)[:, 0]


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
    """Return half the side of the window, in px, for a map of this width."""
    return max(LEAST_WINDOW_PX, round(WINDOW * depth.shape[1]))
