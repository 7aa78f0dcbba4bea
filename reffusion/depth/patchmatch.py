"""The plane at each pixel of a photograph under which others look most like it: PatchMatch stereo, compiled.

Slanted windows (Bleyer, Rhemann, Rother 2011) in several views (Galliani, Lasinger, Schindler 2015), compared by
bilaterally weighted correlation (Schönberger et al. 2016). A plane is given by its disparity: plane . (x, y, 1) = 1/z
along the ray of a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from reffusion import geometry
from reffusion.depth.sparse_to_dense import UNIT
from reffusion.kernels.compiled import kernel, parallel_for
from reffusion.kernels.vectors import take_ticket
from reffusion.types import Camera

ROUNDS = 3
HALF, STRIDE = 5, 2  # px of a picture `UNIT` wide: a window's half side, and the way from sample to sample
COLOUR, REACH = 36.0, 8.0  # levels (the sum of three channels) and pixels over which a sample's weight falls to 1/e
FLAT = 2.0  # levels of 255: what deviates less looks like anything
DOUBT, FAR = 0.1, 0.02  # a cost for depth that is not the believed one, in full at this relative disparity
SHIFT, TILT = 0.02, 0.16  # relative changes of a plane's disparity, and of its slope, tried in the first round
SHRINK, FINE = 0.4, 0.2  # of these from round to round, and for the second try of each
_SAMPLES = (2 * HALF // STRIDE + 1) ** 2
_STEPS = np.array([(0, 1), (0, -1), (1, 0), (-1, 0), (0, 5), (0, -5), (5, 0), (-5, 0)])  # odd, see `_spread`
_WAYS = len(_STEPS) + 2  # the planes that are tried at a pixel: its neighbours', and two changes of its own


def fitted(
    camera: Camera,
    image: np.ndarray,
    others: Sequence[tuple[Camera, np.ndarray]],
    believed: np.ndarray,
    noise: np.random.Generator,
) -> np.ndarray:
    """[H, W, 3] planes, from those of the believed depth on.

    Args:
        image: uint8 [H, W, 3]. others: at least one camera with its image.
        believed: [H, W] camera z > 0; where photographs tell nothing, it stays.
    """
    rays = np.ascontiguousarray(geometry.pixel_rays(camera))
    own = 1 / np.asarray(believed, np.float64)
    homographies = [_homography(camera, other) for other, _ in others]
    turns, moves = (np.stack(each) for each in zip(*homographies, strict=True))
    pictures, sizes = _stacked([_grey(each) for _, each in others])
    views = (image.astype(np.float32), _grey(image), rays, own, turns, moves, pictures, sizes)
    planes, cost = tangents(own, rays), np.full(own.shape, np.inf)
    spacing = max(1, round(camera.width / UNIT))
    for k in range(ROUNDS):
        size, drawn = SHRINK**k, noise.standard_normal((*own.shape, 3))
        for parity in (0, 1):
            parallel_for(_spread, *views, planes, cost, drawn, parity, k == 0, size, spacing)
    return planes


def tangents(disparity: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """[H, W, 3]: the planes that touch a map of disparity [H, W]; at a step, those of the flatter side."""
    slopes = []
    for axis, apart in ((1, rays[0, 1, 0] - rays[0, 0, 0]), (0, rays[1, 0, 1] - rays[0, 0, 1])):
        change = np.diff(disparity, axis=axis) / apart
        first, last = (np.take(change, [end], axis) for end in (0, -1))
        behind, ahead = np.concatenate([first, change], axis), np.concatenate([change, last], axis)
        flatter = np.where(np.abs(behind) < np.abs(ahead), behind, ahead)
        slopes.append(cv2.medianBlur(flatter.astype(np.float32), 5).astype(np.float64))
    x, y = slopes
    return np.stack([x, y, disparity - x * rays[..., 0] - y * rays[..., 1]], -1)


def _homography(camera: Camera, other: Camera) -> tuple[np.ndarray, np.ndarray]:
    """([3, 3], [3]): a ray of the camera lies at turn @ ray + move * disparity, divided by its third, of the other."""
    inner = np.array([[other.fx, 0, other.cx], [0, other.fy, other.cy], [0, 0, 1]])
    relative = other.world_to_camera @ np.linalg.inv(camera.world_to_camera)
    return inner @ relative[:3, :3], inner @ relative[:3, 3]


def _grey(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)


def _stacked(pictures: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """[K, H, W], as high and wide as the largest, and the heights and widths [K, 2]."""
    sizes = np.array([picture.shape for picture in pictures])
    result = np.zeros((len(pictures), *sizes.max(0)), np.float32)
    for whole, picture in zip(result, pictures, strict=True):
        whole[: picture.shape[0], : picture.shape[1]] = picture
    return result, sizes


@kernel
def _weigh(colour, row, column, spacing, weights):
    """The weight of each sample of a window, by how like its colour is; 0 outside the picture. Returns their sum."""
    height, width = colour.shape[:2]
    n, total = 0, 0.0
    for down in range(-HALF, HALF + 1, STRIDE):
        for across in range(-HALF, HALF + 1, STRIDE):
            y, x = row + spacing * down, column + spacing * across
            weights[n] = 0.0
            if y >= 0 and y < height and x >= 0 and x < width:
                unlike = 0.0
                for k in range(3):
                    unlike += abs(colour[y, x, k] - colour[row, column, k])
                weights[n] = np.exp(-unlike / COLOUR - np.sqrt(float(down * down + across * across)) / REACH)
                total += weights[n]
            n += 1
    return total


@kernel
def _unlike(grey, rays, turn, move, picture, size, row, column, plane, spacing, weights, total):
    """1 less the correlation of a window with what another photograph shows of the plane; 1 where it shows too little
    of it."""
    height, width = size
    n, seen = 0, 0.0
    mean_here, mean_there, square_here, square_there, product = 0.0, 0.0, 0.0, 0.0, 0.0
    for down in range(-HALF, HALF + 1, STRIDE):
        for across in range(-HALF, HALF + 1, STRIDE):
            w = weights[n]
            n += 1
            if w == 0.0:
                continue
            r, c = row + spacing * down, column + spacing * across
            x, y = rays[r, c, 0], rays[r, c, 1]
            disparity = plane[0] * x + plane[1] * y + plane[2]
            z = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] + move[2] * disparity
            if not z > 0:
                continue
            u = (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] + move[0] * disparity) / z - 0.5
            v = (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] + move[1] * disparity) / z - 0.5
            if not (u >= 0 and v >= 0 and u < width - 1 and v < height - 1):
                continue
            i, j = int(v), int(u)
            right, below = u - j, v - i
            upper = (1 - right) * picture[i, j] + right * picture[i, j + 1]
            lower = (1 - right) * picture[i + 1, j] + right * picture[i + 1, j + 1]
            there, here = (1 - below) * upper + below * lower, grey[r, c]
            seen += w
            mean_here += w * here
            mean_there += w * there
            square_here += w * here * here
            square_there += w * there * there
            product += w * here * there
    if seen < 0.5 * total:
        return 1.0
    mean_here /= seen
    mean_there /= seen
    here = max(square_here / seen - mean_here * mean_here, 0.0) + FLAT * FLAT
    there = max(square_there / seen - mean_there * mean_there, 0.0) + FLAT * FLAT
    return min(1.0, 1.0 - (product / seen - mean_here * mean_there) / np.sqrt(here * there))


@kernel
def _cost(grey, rays, own, turns, moves, pictures, sizes, row, column, plane, spacing, weights, total):
    """Of a plane at a pixel: how unlike the photograph most like it is, of three the two, and a doubt."""
    x, y = rays[row, column, 0], rays[row, column, 1]
    disparity = plane[0] * x + plane[1] * y + plane[2]
    if not disparity > 0:
        return np.inf
    best, second = 1.0, 1.0
    for k in range(len(turns)):
        found = _unlike(
            grey, rays, turns[k], moves[k], pictures[k], sizes[k], row, column, plane, spacing, weights, total
        )
        if found < best:
            best, second = found, best
        elif found < second:
            second = found
    shown = best if len(turns) < 3 else 0.5 * (best + second)
    return shown + DOUBT * min(1.0, abs(disparity / own[row, column] - 1) / FAR)


@kernel
def _spread(
    tickets,
    colour,
    grey,
    rays,
    own,
    turns,
    moves,
    pictures,
    sizes,
    planes,
    cost,
    drawn,
    parity,
    first,
    size,
    spacing,
):
    """Let every second pixel, as on a chessboard, take the plane that costs least of those around it, which are of the
    other colour and so do not change meanwhile, and two changes of its own."""
    height, width = grey.shape
    weights, plane = np.empty(_SAMPLES), np.empty(3)
    views = grey, rays, own, turns, moves, pictures, sizes
    while True:
        row = take_ticket(tickets)
        if row >= height:
            return
        for column in range((row + parity) % 2, width, 2):
            total = _weigh(colour, row, column, spacing, weights)
            if first:
                plane[:] = planes[row, column]
                cost[row, column] = _cost(*views, row, column, plane, spacing, weights, total)
            for way in range(_WAYS):
                if way < len(_STEPS):
                    y, x = row + spacing * _STEPS[way, 0], column + spacing * _STEPS[way, 1]
                    if y < 0 or y >= height or x < 0 or x >= width:
                        continue
                    plane[:] = planes[y, x]
                else:
                    _changed(planes[row, column], rays[row, column], drawn[row, column], size, way, plane)
                found = _cost(*views, row, column, plane, spacing, weights, total)
                if found < cost[row, column]:
                    cost[row, column] = found
                    planes[row, column] = plane


@kernel
def _changed(plane, ray, drawn, size, way, result):
    """Write a plane a little nearer or farther at a ray, and turned about that point."""
    here = plane[0] * ray[0] + plane[1] * ray[1] + plane[2]
    scale = here * size * (1.0 if way == _WAYS - 2 else FINE)
    across, down = TILT * scale * drawn[0], TILT * scale * drawn[1]
    result[0] = plane[0] + across
    result[1] = plane[1] + down
    result[2] = plane[2] + SHIFT * scale * drawn[2] - across * ray[0] - down * ray[1]
