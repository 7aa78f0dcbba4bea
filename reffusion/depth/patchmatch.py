"""PatchMatch stereo in compiled code. It finds the plane at each pixel of a photograph that matches other views best.

A plane maps a window around the pixel to windows in the other views (slanted support windows, Bleyer, Rhemann, Rother
2011; several views, Galliani, Lasinger, Schindler 2015). The windows are compared by bilaterally weighted normalized
cross-correlation (Schönberger et al. 2016). A plane is a vector [3] of its coefficients in disparity: plane . (x, y, 1)
= 1/z, the disparity at which the ray (x, y, 1) of a pixel meets the plane, in camera axes.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from reffusion import geometry
from reffusion.depth.sparse_to_dense import REFERENCE_WIDTH
from reffusion.io.images import to_gray
from reffusion.kernels.compiled import kernel, parallel_for
from reffusion.kernels.vectors import take_ticket
from reffusion.types import Camera

ITERATIONS = 3
WINDOW_HALF, WINDOW_STRIDE = (
    5,
    2,
)  # half side of a window and spacing of its samples, in px of a picture `REFERENCE_WIDTH` wide
COLOR_SCALE, DISTANCE_SCALE = 36.0, 8.0  # levels (sum of three channels) and px at which a sample's weight is 1/e
MIN_DEVIATION = 2.0  # levels of 255, regularizes the correlation of windows with less contrast
# The cost of leaving the initial depth, and the relative difference in disparity at which it reaches this value.
PRIOR_COST, PRIOR_TOLERANCE = 0.1, 0.02
DISPARITY_CHANGE, SLOPE_CHANGE = (
    0.02,
    0.16,
)  # relative random changes of a plane's disparity and of its slope in the first iteration
CHANGE_DECAY, SMALL_CHANGE = (
    0.4,
    0.2,
)  # factors on both changes: from one iteration to the next, and for the second random change of each pixel
_SAMPLES = (2 * WINDOW_HALF // WINDOW_STRIDE + 1) ** 2
_NEIGHBORS = np.array(
    [(0, 1), (0, -1), (1, 0), (-1, 0), (0, 5), (0, -5), (5, 0), (-5, 0)]
)  # (row, column) offsets in units of `spacing`: each is odd, so it leads to the other color, see `_spread`
_CANDIDATES = len(_NEIGHBORS) + 2  # planes tried at a pixel: those of its neighbors, and two random changes of its own


def estimate_planes(
    camera: Camera,
    image: np.ndarray,
    others: Sequence[tuple[Camera, np.ndarray]],
    initial: np.ndarray,
    generator: np.random.Generator,
) -> np.ndarray:
    """Return [H, W, 3], for each pixel of a photograph the plane that matches the other views best (see the module).

    The search starts from the tangent planes of an initial depth map.

    Args:
        camera: The camera of the photograph.
        image: uint8 [H, W, 3], the photograph.
        others: At least one other camera with its photograph, uint8 of its own size.
        initial: [H, W] camera z > 0. A plane pays a cost for leaving this depth, so the initial depth is kept where the
            photographs do not determine the depth.
        generator: Draws the random changes of planes.
    """
    rays = np.ascontiguousarray(geometry.pixel_rays(camera))
    initial_disparity = 1 / np.asarray(initial, np.float64)
    homographies = [_homography(camera, other) for other, _ in others]
    rotations, translations = (np.stack(each) for each in zip(*homographies, strict=True))
    pictures, sizes = _stack_padded([to_gray(each) for _, each in others])
    views = (
        image.astype(np.float32),
        to_gray(image),
        rays,
        initial_disparity,
        rotations,
        translations,
        pictures,
        sizes,
    )
    planes, cost = tangent_planes(initial_disparity, rays), np.full(initial_disparity.shape, np.inf)
    spacing = max(1, round(camera.width / REFERENCE_WIDTH))
    for k in range(ITERATIONS):
        change_size, noise = CHANGE_DECAY**k, generator.standard_normal((*initial_disparity.shape, 3))
        for parity in (0, 1):
            parallel_for(_spread, *views, planes, cost, noise, parity, k == 0, change_size, spacing)
    return planes


def tangent_planes(disparity: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return [H, W, 3], the tangent plane of a disparity map at each pixel.

    The slopes are one-sided differences. Of the two sides of a pixel the flatter one is taken, so that a plane beside a
    depth step does not bridge the step. The slopes are then smoothed by a median filter of 5 x 5 pixels.

    Args:
        disparity: [H, W], 1/z.
        rays: [H, W, 3], the rays of the pixels (`geometry.pixel_rays`).
    """
    slopes = []
    for axis, pixel_distance in ((1, rays[0, 1, 0] - rays[0, 0, 0]), (0, rays[1, 0, 1] - rays[0, 0, 1])):
        slope = np.diff(disparity, axis=axis) / pixel_distance
        first, last = (np.take(slope, [end], axis) for end in (0, -1))
        behind, ahead = np.concatenate([first, slope], axis), np.concatenate([slope, last], axis)
        flatter = np.where(np.abs(behind) < np.abs(ahead), behind, ahead)
        slopes.append(cv2.medianBlur(flatter.astype(np.float32), 5).astype(np.float64))
    x, y = slopes
    return np.stack([x, y, disparity - x * rays[..., 0] - y * rays[..., 1]], -1)


def _homography(camera: Camera, other: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return a matrix [3, 3] and a vector [3] that map a pixel's ray and disparity to a pixel of another view."""
    inner = np.array([[other.fx, 0, other.cx], [0, other.fy, other.cy], [0, 0, 1]])
    relative = other.world_to_camera @ np.linalg.inv(camera.world_to_camera)
    # The homogeneous pixel in `other` is matrix @ ray + vector * disparity, where ray = (x, y, 1) in `camera`.
    return inner @ relative[:3, :3], inner @ relative[:3, 3]


def _stack_padded(pictures: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return pictures [H_k, W_k] as one array [K, H, W], padded with zeros, and their sizes (height, width), [K, 2]."""
    sizes = np.array([picture.shape for picture in pictures])
    result = np.zeros((len(pictures), *sizes.max(0)), np.float32)
    for whole, picture in zip(result, pictures, strict=True):
        whole[: picture.shape[0], : picture.shape[1]] = picture
    return result, sizes


@kernel
def _bilateral_weights(color, row, column, spacing, weights):
    """Write the bilateral weights of the samples of a window to `weights`, [_SAMPLES], and return their sum."""
    # `color` has levels from 0 to 255. `spacing` is the factor on the window's size in pixels: 1 for a picture
    # `REFERENCE_WIDTH` wide, 2 for one twice as wide.
    height, width = color.shape[:2]
    n, total = 0, 0.0
    for down in range(-WINDOW_HALF, WINDOW_HALF + 1, WINDOW_STRIDE):
        for across in range(-WINDOW_HALF, WINDOW_HALF + 1, WINDOW_STRIDE):
            y, x = row + spacing * down, column + spacing * across
            weights[n] = 0.0
            if y >= 0 and y < height and x >= 0 and x < width:
                difference = 0.0
                for k in range(3):
                    difference += abs(color[y, x, k] - color[row, column, k])
                weights[n] = np.exp(
                    -difference / COLOR_SCALE - np.sqrt(float(down * down + across * across)) / DISTANCE_SCALE
                )
                total += weights[n]
            n += 1
    return total


@kernel
def _matching_cost(gray, rays, rotation, translation, picture, size, row, column, plane, spacing, weights, total):
    """Return 1 - the correlation of a window with the window that `plane` maps to in another view, at most 1."""
    # `rotation` and `translation` are those of `_homography`, `picture` is the other view in gray, padded by
    # `_stack_padded`, and `size` its size before padding. `weights` and `total` are those of `_bilateral_weights`.
    height, width = size
    n, covered = 0, 0.0
    mean_here, mean_there, square_here, square_there, product = 0.0, 0.0, 0.0, 0.0, 0.0
    for down in range(-WINDOW_HALF, WINDOW_HALF + 1, WINDOW_STRIDE):
        for across in range(-WINDOW_HALF, WINDOW_HALF + 1, WINDOW_STRIDE):
            w = weights[n]
            n += 1
            if w == 0.0:
                continue
            r, c = row + spacing * down, column + spacing * across
            x, y = rays[r, c, 0], rays[r, c, 1]
            disparity = plane[0] * x + plane[1] * y + plane[2]
            z = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] + translation[2] * disparity
            if not z > 0:
                continue
            u = (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] + translation[0] * disparity) / z - 0.5
            v = (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] + translation[1] * disparity) / z - 0.5
            if not (u >= 0 and v >= 0 and u < width - 1 and v < height - 1):
                continue
            i, j = int(v), int(u)
            right, below = u - j, v - i
            upper = (1 - right) * picture[i, j] + right * picture[i, j + 1]
            lower = (1 - right) * picture[i + 1, j] + right * picture[i + 1, j + 1]
            other, own = (1 - below) * upper + below * lower, gray[r, c]
            covered += w
            mean_here += w * own
            mean_there += w * other
            square_here += w * own * own
            square_there += w * other * other
            product += w * own * other
    # Less than half of the window's weight lies in the frame of the other view.
    if covered < 0.5 * total:
        return 1.0
    mean_here /= covered
    mean_there /= covered
    own = max(square_here / covered - mean_here * mean_here, 0.0) + MIN_DEVIATION * MIN_DEVIATION
    other = max(square_there / covered - mean_there * mean_there, 0.0) + MIN_DEVIATION * MIN_DEVIATION
    return min(1.0, 1.0 - (product / covered - mean_here * mean_there) / np.sqrt(own * other))


@kernel
def _plane_cost(
    gray, rays, initial_disparity, rotations, translations, pictures, sizes, row, column, plane, spacing, weights, total
):
    """Return the cost of a plane at a pixel: the matching cost, and a penalty for leaving the initial depth."""
    x, y = rays[row, column, 0], rays[row, column, 1]
    disparity = plane[0] * x + plane[1] * y + plane[2]
    if not disparity > 0:
        return np.inf
    best, second = 1.0, 1.0
    for k in range(len(rotations)):
        cost = _matching_cost(
            gray,
            rays,
            rotations[k],
            translations[k],
            pictures[k],
            sizes[k],
            row,
            column,
            plane,
            spacing,
            weights,
            total,
        )
        if cost < best:
            best, second = cost, best
        elif cost < second:
            second = cost
    # The matching cost is the lowest of those in the other views. With three or more other views it is the mean of the
    # two lowest.
    data_cost = best if len(rotations) < 3 else 0.5 * (best + second)
    return data_cost + PRIOR_COST * min(1.0, abs(disparity / initial_disparity[row, column] - 1) / PRIOR_TOLERANCE)


@kernel
def _spread(
    tickets,
    color,
    gray,
    rays,
    initial_disparity,
    rotations,
    translations,
    pictures,
    sizes,
    planes,
    cost,
    noise,
    parity,
    first,
    change_size,
    spacing,
):
    """Update the planes of half of the pixels, in a chessboard pattern, to planes of lower cost, in place."""
    height, width = gray.shape
    weights, plane = np.empty(_SAMPLES), np.empty(3)
    views = gray, rays, initial_disparity, rotations, translations, pictures, sizes
    # `noise` [H, W, 3] is standard normal and gives the random changes; `change_size` is a factor on them. `spacing` is
    # that of `_bilateral_weights`, and also the factor on the distances of the neighbors.
    while True:
        row = take_ticket(tickets)
        if row >= height:
            return
        for column in range(width):
            # The squares of the chessboard have sides of `spacing` pixels. So the neighbors are in squares of the
            # other color, and their planes do not change during the update. The result does not depend on the order in
            # which threads take rows.
            if (row // spacing + column // spacing + parity) % 2:
                continue
            total = _bilateral_weights(color, row, column, spacing, weights)
            # The first iteration computes the costs of the initial planes.
            if first:
                _copy_plane(planes[row, column], plane)
                cost[row, column] = _plane_cost(*views, row, column, plane, spacing, weights, total)
            # The candidates are the planes of eight neighbors and two random changes of the own plane.
            for candidate in range(_CANDIDATES):
                if candidate < len(_NEIGHBORS):
                    y, x = row + spacing * _NEIGHBORS[candidate, 0], column + spacing * _NEIGHBORS[candidate, 1]
                    if y < 0 or y >= height or x < 0 or x >= width:
                        continue
                    _copy_plane(planes[y, x], plane)
                else:
                    _perturb(planes[row, column], rays[row, column], noise[row, column], change_size, candidate, plane)
                new_cost = _plane_cost(*views, row, column, plane, spacing, weights, total)
                if new_cost < cost[row, column]:
                    cost[row, column] = new_cost
                    _copy_plane(plane, planes[row, column])


@kernel
def _copy_plane(plane, target):
    """Copy the three numbers of a plane; assigning the array to a slice takes seconds to compile."""
    for k in range(3):
        target[k] = plane[k]


@kernel
def _perturb(plane, ray, noise, change_size, candidate, result):
    """Write a randomly changed copy of a plane to `result`; `noise` [3] is standard normal."""
    disparity = plane[0] * ray[0] + plane[1] * ray[1] + plane[2]
    # The last candidate gets a smaller change.
    scale = disparity * change_size * (1.0 if candidate == _CANDIDATES - 2 else SMALL_CHANGE)
    across, down = SLOPE_CHANGE * scale * noise[0], SLOPE_CHANGE * scale * noise[1]
    # The plane's disparity at the pixel's ray is changed, and the plane is tilted about its point on this ray.
    result[0] = plane[0] + across
    result[1] = plane[1] + down
    result[2] = plane[2] + DISPARITY_CHANGE * scale * noise[2] - across * ray[0] - down * ray[1]
