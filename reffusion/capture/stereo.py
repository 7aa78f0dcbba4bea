"""Dense matches between views: optical flow to the neighbours, triangulated where several agree.

Sparse points come from corners that a matcher is sure of. Where there are none, in foliage, on distant facades, in the
sky, 3DGS has to grow Gaussians from distant ones, and a short run does not get there. Flow gives points everywhere in
seconds. The cameras tell which flow vectors are right, and the vectors in turn reveal wrong cameras
(`reffusion.capture.refine`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch

from reffusion.types import Camera

NEIGHBOURS = 4  # views that a view is matched with
TURN = np.cos(np.radians(40))  # cosine of 40 degrees: views whose axes differ by more are not matched
ROUND_TRIP = 1.5  # px: largest distance between a pixel and where forward and backward flow lead
RESIDUAL = 1.5  # px: largest reprojection error of a point against the flow
LEAST_CONTRAST = 0.7  # levels of 255: standard deviation in a window of 9 px under which nothing can be matched
NOISE = 0.3  # px: assumed standard deviation of flow; depths that it cannot tell from infinity are dropped
FARTHEST = 20.0  # frame units: points beyond, the sky too, are moved to this depth
ZOOM = 1.1  # ratio of focal lengths from which a neighbour is resampled through this view's lens
SAME_DEPTH = 0.1  # relative difference of depth under which two views' points show the same surface


@dataclass(frozen=True)
class Matches:
    """Pixels of a view, and where its neighbours show the same.

    Attributes:
        view: name of the view; pixels: [P, 2] float64 coordinates (x, y) in it.
        others: names of K neighbours; places: [K, P, 2] coordinates in them; seen: [K, P] bool, forward and backward
            flow agree, so the coordinates are valid.
    """

    view: str
    pixels: np.ndarray
    others: tuple[str, ...]
    places: np.ndarray
    seen: np.ndarray


def triangulate_points(
    cameras: Sequence[Camera], images: Mapping[str, np.ndarray], cell: int
) -> tuple[np.ndarray, np.ndarray]:
    """A point per `cell` x `cell` pixels of the first view, and of every further view where there is no point yet.

    Args:
        cameras: undistorted views in the normalised frame; with fewer than two there are no points.
        images: view name -> uint8 [H, W, 3].
        cell: px, at least 1.

    Returns:
        points [P, 3] float64 and their colours [P, 3] uint8.
    """
    by_name = {camera.name: camera for camera in cameras}
    points, colors = np.empty((0, 3)), [np.empty((0, 3), np.uint8)]
    for matches in match_views(cameras, cameras, images, cell):
        camera = by_name[matches.view]
        depth, known = triangulate(matches, by_name)
        depth = np.minimum(depth, FARTHEST)
        fresh = known & ~_is_covered(camera, points, matches.pixels, depth, cell)
        pixels, depth = matches.pixels[fresh], depth[fresh]
        columns, rows = pixels.astype(int).T
        points = np.concatenate([points, unproject(camera, pixels, depth)])
        colors.append(cv2.blur(images[camera.name], (cell, cell))[rows, columns])
    return points, np.concatenate(colors)


# ---------------------------------------------------------------------------------------------- flow


def match_views(
    chosen: Sequence[Camera], cameras: Sequence[Camera], images: Mapping[str, np.ndarray], cell: int
) -> Iterator[Matches]:
    """Match the `chosen` views with their neighbours among `cameras`, one pixel per cell; yields in the order of
    `chosen`."""
    gray = {camera.name: cv2.cvtColor(images[camera.name], cv2.COLOR_RGB2GRAY) for camera in cameras}
    neighbours_of = {camera.name: tuple(other.name for other in find_neighbours(camera, cameras)) for camera in chosen}
    pairs = list(dict.fromkeys(tuple(sorted((name, other))) for name in neighbours_of for other in neighbours_of[name]))
    found = {}
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        by_name = {camera.name: camera for camera in cameras}
        side = lambda name: (by_name[name], gray[name])
        both_ways = pool.map(lambda pair: _flow_both_ways(side(pair[0]), side(pair[1]), cell), pairs)
        for (one, other), (forward, back) in zip(pairs, both_ways, strict=True):
            found[one, other], found[other, one] = forward, back
    for camera in chosen:
        pixels = _pixels(gray[camera.name], cell).reshape(-1, 2)
        places, seen = np.empty((len(neighbours_of[camera.name]), *pixels.shape)), np.empty((0, len(pixels)), bool)
        if len(places):
            places, seen = map(
                np.stack, zip(*(found[camera.name, other] for other in neighbours_of[camera.name]), strict=True)
            )
        yield Matches(camera.name, pixels, neighbours_of[camera.name], places, seen)


def find_neighbours(camera: Camera, cameras: Sequence[Camera]) -> list[Camera]:
    """The `NEIGHBOURS` nearest views at other places that look in about the same direction."""
    away = {other.name: float(np.linalg.norm(other.center - camera.center)) for other in cameras}
    axis = camera.world_to_camera[2, :3]
    others = [o for o in cameras if away[o.name] > 1e-6 and o.world_to_camera[2, :3] @ axis > TURN]
    return sorted(others, key=lambda other: away[other.name])[:NEIGHBOURS]


def _pixels(gray: np.ndarray, cell: int) -> np.ndarray:
    """[h, w, 2], the pixel (x, y) that stands for each cell."""
    rows, columns = np.arange(cell // 2, gray.shape[0], cell), np.arange(cell // 2, gray.shape[1], cell)
    return np.stack(np.meshgrid(columns, rows), -1) + 0.5


def _flow_both_ways(
    one: tuple[Camera, np.ndarray], other: tuple[Camera, np.ndarray], cell: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each of two views, camera and picture, the coordinates [P, 2] of its pixels in the other, and whether they
    are valid [P]."""
    if not _has_same_scale(one[0], other[0]):
        return [_follow_resampled(*one, *other, cell), _follow_resampled(*other, *one, cell)]
    forward, back = _flow(one[1], other[1]), _flow(other[1], one[1])
    return [_follow_flow(one[1], forward, back, cell), _follow_flow(other[1], back, forward, cell)]


def _flow(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(one, other, None)


def _has_same_scale(one: Camera, other: Camera) -> bool:
    """Do both views show things at about the same size, in pictures of the same size?"""
    zoom = max(one.fx / other.fx, other.fx / one.fx, one.fy / other.fy, other.fy / one.fy)
    return (one.width, one.height) == (other.width, other.height) and zoom < ZOOM


def _follow_resampled(
    camera: Camera, gray: np.ndarray, other: Camera, picture: np.ndarray, cell: int
) -> tuple[np.ndarray, np.ndarray]:
    """`_follow_flow` for a neighbour of another size or lens: its picture is resampled as this view's lens would have
    shown it."""
    scale = np.array([camera.fx / other.fx, camera.fy / other.fy])
    # pixel coordinates as in docs/architecture.md; OpenCV counts from the centre of the first pixel
    shift = np.array([camera.cx, camera.cy]) - scale * (other.cx, other.cy)
    if scale.min() < 1:
        picture = cv2.GaussianBlur(picture, (0, 0), 0.5 / scale.min())
    warp = np.array([[scale[0], 0, shift[0] + scale[0] / 2 - 0.5], [0, scale[1], shift[1] + scale[1] / 2 - 0.5]])
    resampled = cv2.warpAffine(picture, warp, (camera.width, camera.height), borderMode=cv2.BORDER_REPLICATE)
    places, seen = _follow_flow(gray, _flow(gray, resampled), _flow(resampled, gray), cell)
    places = (places - shift) / scale
    return places, seen & ((places > 0) & (places < (other.width, other.height))).all(-1)


def _follow_flow(gray: np.ndarray, forward: np.ndarray, back: np.ndarray, cell: int) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates [P, 2] that flow leads to, one pixel per cell, and [P] bool: the way back agrees and the place has
    contrast."""
    pixels = _pixels(gray, cell)
    columns, rows = pixels.astype(int).transpose(2, 0, 1)
    moved = forward[rows, columns]
    at = (pixels + moved - 0.5).astype(np.float32)
    # beyond the border no way back agrees
    returned = cv2.remap(back, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1e6,) * 4)
    agree = np.linalg.norm(moved + returned, axis=-1) < ROUND_TRIP
    seen = (_local_contrast(gray)[rows, columns] > LEAST_CONTRAST) & agree
    return (pixels + moved).reshape(-1, 2), seen.reshape(-1)


def _local_contrast(gray: np.ndarray) -> np.ndarray:
    """[H, W] standard deviation in a window around each pixel."""
    wide = gray.astype(np.float32)
    return np.sqrt(np.maximum(cv2.blur(wide**2, (9, 9)) - cv2.blur(wide, (9, 9)) ** 2, 0))


# ---------------------------------------------------------------------------------------------- depth


def triangulate(matches: Matches, cameras: Mapping[str, Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Depths of a view's pixels from where other views see the same things.

    A point at inverse depth r on a pixel's ray (whose z is 1) is R ray + r t, up to scale, in another view. Its
    reprojection error times its depth there is linear in r. Each neighbour proposes an r. The proposal that most
    neighbours agree with, within `RESIDUAL` px, is refined by least squares over those.

    Args:
        cameras: view name -> camera, of the view and its neighbours.

    Returns:
        depth [P], very large where there is no parallax; and [P] bool, whether at least two neighbours agree on it
        (one, if there is only one).
    """
    count = len(matches.pixels)
    if not matches.others:
        return np.full(count, np.inf), np.zeros(count, bool)
    lines = _reprojection_lines(matches, cameras)
    inverse, votes = np.zeros(count), np.full(count, -1)
    for line in lines:
        proposal = _solve_inverse_depth([line], [1.0])[0]
        agree = sum(_agrees(line, proposal) & seen for line, seen in zip(lines, matches.seen, strict=True))
        inverse, votes = np.where(agree > votes, proposal, inverse), np.maximum(votes, agree)
    for _ in range(2):
        agree = [_agrees(line, inverse) & seen for line, seen in zip(lines, matches.seen, strict=True)]
        weights = [
            a / np.maximum(_neighbour_depth(line, inverse), 1e-3) ** 2 for line, a in zip(lines, agree, strict=True)
        ]
        inverse, square = _solve_inverse_depth(lines, weights)
    known = (np.sum(agree, 0) >= min(2, len(lines))) & (inverse > -2 * NOISE / np.sqrt(square))
    return 1 / np.maximum(inverse, 1e-9), known


def flow_residuals(matches: Matches, cameras: Mapping[str, Camera], depth: np.ndarray) -> np.ndarray:
    """[K, P, 2] px from where flow saw a pixel's point to where the neighbours' cameras project it; NaN behind a
    camera."""
    found = []
    for line in _reprojection_lines(matches, cameras):
        z = _neighbour_depth(line, 1 / depth)
        z = np.where(z > 1e-3, z, np.nan)
        found.append((line.slope / depth[:, None] + line.offset) / z[:, None])
    return np.array(found).reshape(len(matches.others), len(depth), 2)


class _ReprojectionLine(NamedTuple):
    """In a neighbour, a point at inverse depth r misses its flow by (slope r + offset) / (z + shift r) px."""

    slope: np.ndarray  # [P, 2]
    offset: np.ndarray  # [P, 2]
    z: np.ndarray  # [P]
    shift: float


def _reprojection_lines(matches: Matches, cameras: Mapping[str, Camera]) -> list[_ReprojectionLine]:
    camera, lines = cameras[matches.view], []
    ray = _rays(camera, matches.pixels)
    for name, place in zip(matches.others, matches.places, strict=True):
        other = cameras[name]
        turn = other.world_to_camera[:3, :3] @ camera.world_to_camera[:3, :3].T
        shift = other.world_to_camera[:3, 3] - turn @ camera.world_to_camera[:3, 3]
        focal, turned = np.array([other.fx, other.fy]), ray @ turn.T
        goal = (place - np.array([other.cx, other.cy])) / focal
        slope, offset = (shift[:2] - goal * shift[2]) * focal, (turned[:, :2] - goal * turned[:, 2:]) * focal
        lines.append(_ReprojectionLine(slope, offset, turned[:, 2], float(shift[2])))
    return lines


def _neighbour_depth(line: _ReprojectionLine, inverse: np.ndarray) -> np.ndarray:
    """Depth in the neighbour, in units of the depth in this view."""
    return line.z + line.shift * inverse


def _agrees(line: _ReprojectionLine, inverse: np.ndarray) -> np.ndarray:
    z = _neighbour_depth(line, inverse)
    miss_x, miss_y = np.abs(line.slope * inverse[:, None] + line.offset).T  # numpy reduces an axis of 2 slowly
    return (z > 1e-3) & (np.maximum(miss_x, miss_y) < RESIDUAL * z)


def _solve_inverse_depth(lines: Sequence[_ReprojectionLine], weights: Sequence) -> tuple[np.ndarray, np.ndarray]:
    """The inverse depth with the least weighted sum of squares, and the denominator of that solution."""
    square = sum(_dot(line.slope, line.slope) * weight for line, weight in zip(lines, weights, strict=True))
    square = np.maximum(square, 1e-12)
    return -sum(_dot(line.slope, line.offset) * w for line, w in zip(lines, weights, strict=True)) / square, square


def _dot(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return one[:, 0] * other[:, 0] + one[:, 1] * other[:, 1]


# ---------------------------------------------------------------------------------------------- points


def _is_covered(camera: Camera, points: np.ndarray, pixels: np.ndarray, depth: np.ndarray, cell: int) -> np.ndarray:
    """[P] bool: one of the points is in the pixel's cell, at about its depth or in front of it."""
    local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    local = local[local[:, 2] > 1e-3]
    column = np.floor((local[:, 0] / local[:, 2] * camera.fx + camera.cx) / cell)
    row = np.floor((local[:, 1] / local[:, 2] * camera.fy + camera.cy) / cell)
    wide, high = -(-camera.width // cell), -(-camera.height // cell)
    inside = (column >= 0) & (column < wide) & (row >= 0) & (row < high)
    grid = np.full((high, wide), np.inf)
    np.minimum.at(grid, (row[inside].astype(int), column[inside].astype(int)), local[inside, 2])
    nearest = grid[(pixels[:, 1] // cell).astype(int), (pixels[:, 0] // cell).astype(int)]
    return nearest < depth * (1 + SAME_DEPTH)


def unproject(camera: Camera, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """[P, 3] the points at these depths behind these pixels [P, 2]."""
    local = _rays(camera, pixels) * depth[:, None] - camera.world_to_camera[:3, 3]
    return local @ camera.world_to_camera[:3, :3]


def _rays(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    x, y = (pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], 1)
