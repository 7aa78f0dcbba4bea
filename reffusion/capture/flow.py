"""Dense matches between views: optical flow to neighboring views, and points triangulated from this flow.

The sparse points of structure from motion come from distinctive corners, which are rare in foliage, on distant facades
and in the sky. In such areas 3DGS would have to grow Gaussians from distant Gaussians, and a short run has too few
steps for this growth. Flow gives points everywhere within seconds. Flow vectors that contradict the cameras are
dropped. Systematic contradictions reveal wrong cameras (`reffusion.capture.refine`).

Matches are made for one pixel per cell, a square of `cell` x `cell` pixels of a view.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch

from reffusion import geometry
from reffusion.types import Camera

NEIGHBORS = 4  # number of views with which each view is matched
TURN = np.cos(np.radians(40))  # cosine of 40 degrees: views whose axes differ by more are not matched
ROUND_TRIP = 1.5  # px: largest distance between a pixel and the end of forward flow followed by backward flow
RESIDUAL = 1.5  # px: largest reprojection error of a point against the flow
LEAST_CONTRAST = 0.7  # levels of 255: standard deviation in a window of 9 px, below which flow is not trusted
# px: assumed standard deviation of flow. A point is dropped if its inverse depth is negative by more than two of the
# standard deviations that follow from it, so that it would lie behind the camera.
NOISE = 0.3
FARTHEST = 20.0  # units of the normalized frame: points farther away, as in the sky, are moved to this depth
ZOOM = 1.1  # ratio of focal lengths from which a neighbor's picture is resampled to this view's focal length


@dataclass(frozen=True)
class Matches:
    """The pixels of a view, and the pixels in its neighbors that show the same points, by optical flow.

    Attributes:
        view: name of the view.
        pixels: [P, 2] float64, coordinates (x, y) of pixels in the view.
        others: names of the K neighbors.
        places: [K, P, 2], coordinates (x, y) of the matching pixels in the neighbors.
        seen: [K, P] bool, True if the match is valid: forward and backward flow agree, and the pixel has contrast.
            `places` is meaningless elsewhere.
    """

    view: str
    pixels: np.ndarray
    others: tuple[str, ...]
    places: np.ndarray
    seen: np.ndarray


def triangulate_points(
    cameras: Sequence[Camera], images: Mapping[str, np.ndarray], cell: int
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate points from the optical flow between views, about one point per cell of the pictures.

    A cell of a view gets no point if its match is unreliable, or if points of earlier views already cover it. Points
    with a depth above `FARTHEST` are moved to this depth.

    Args:
        cameras: cameras of undistorted views in the normalized frame. Fewer than two give no points.
        images: view name -> uint8 [H, W, 3].
        cell: side of a cell in pixels, at least 1.

    Returns:
        The points [P, 3] float64 and their colors [P, 3] uint8. A color is the mean over a square of the cell's size.
    """
    by_name = {camera.name: camera for camera in cameras}
    points, colors = np.empty((0, 3)), [np.empty((0, 3), np.uint8)]
    for matches in match_views(cameras, cameras, images, cell):
        camera = by_name[matches.view]
        depth, known = depths_from_matches(matches, by_name)
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
    """Yield the matches of each of the `chosen` views with its neighbors among `cameras`, one pixel per cell.

    Args:
        chosen: some of the `cameras`. A view without neighbors has matches with K = 0.
        images: view name -> uint8 [H, W, 3], for all `cameras`.
        cell: side of a cell in pixels.
    """
    gray = {camera.name: cv2.cvtColor(images[camera.name], cv2.COLOR_RGB2GRAY) for camera in cameras}
    neighbors_of = {camera.name: tuple(other.name for other in find_neighbors(camera, cameras)) for camera in chosen}
    pairs = list(dict.fromkeys(tuple(sorted((name, other))) for name in neighbors_of for other in neighbors_of[name]))
    found = {}
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        by_name = {camera.name: camera for camera in cameras}
        side = lambda name: (by_name[name], gray[name])
        both_ways = pool.map(lambda pair: _flow_both_ways(side(pair[0]), side(pair[1]), cell), pairs)
        for (one, other), (forward, back) in zip(pairs, both_ways, strict=True):
            found[one, other], found[other, one] = forward, back
    for camera in chosen:
        pixels = _pixels(gray[camera.name], cell).reshape(-1, 2)
        places, seen = np.empty((len(neighbors_of[camera.name]), *pixels.shape)), np.empty((0, len(pixels)), bool)
        if len(places):
            places, seen = map(
                np.stack, zip(*(found[camera.name, other] for other in neighbors_of[camera.name]), strict=True)
            )
        yield Matches(camera.name, pixels, neighbors_of[camera.name], places, seen)


def find_neighbors(camera: Camera, cameras: Sequence[Camera]) -> list[Camera]:
    """Return the nearest cameras at other places whose axes are within 40 degrees (`TURN`) of that of `camera`.

    The list holds at most `NEIGHBORS` cameras, the nearest first.
    """
    away = {other.name: float(np.linalg.norm(other.center - camera.center)) for other in cameras}
    axis = camera.world_to_camera[2, :3]
    others = [o for o in cameras if away[o.name] > 1e-6 and o.world_to_camera[2, :3] @ axis > TURN]
    return sorted(others, key=lambda other: away[other.name])[:NEIGHBORS]


def _pixels(gray: np.ndarray, cell: int) -> np.ndarray:
    """Return [h, w, 2], the coordinates (x, y) of one pixel per cell, for h x w cells."""
    rows, columns = np.arange(cell // 2, gray.shape[0], cell), np.arange(cell // 2, gray.shape[1], cell)
    return np.stack(np.meshgrid(columns, rows), -1) + 0.5


def _flow_both_ways(
    one: tuple[Camera, np.ndarray], other: tuple[Camera, np.ndarray], cell: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Match the pixels of two views (camera, gray picture) both ways; return `_follow_flow` for each view."""
    if not _has_same_scale(one[0], other[0]):
        return [_follow_resampled(*one, *other, cell), _follow_resampled(*other, *one, cell)]
    forward, back = _flow(one[1], other[1]), _flow(other[1], one[1])
    return [_follow_flow(one[1], forward, back, cell), _follow_flow(other[1], back, forward, cell)]


def _flow(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the optical flow [H, W, 2] from one gray picture, uint8 [H, W], to another of the same size."""
    return cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(one, other, None)


def _has_same_scale(one: Camera, other: Camera) -> bool:
    """Return whether two views have pictures of the same size and about equal focal lengths (`ZOOM`)."""
    zoom = max(one.fx / other.fx, other.fx / one.fx, one.fy / other.fy, other.fy / one.fy)
    return (one.width, one.height) == (other.width, other.height) and zoom < ZOOM


def _follow_resampled(
    camera: Camera, gray: np.ndarray, other: Camera, picture: np.ndarray, cell: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return `_follow_flow` to a neighbor, `other` and `picture`, of another picture size or focal length."""
    scale = np.array([camera.fx / other.fx, camera.fy / other.fy])
    # pixel coordinates as in docs/architecture.md; OpenCV counts from the center of the first pixel
    shift = np.array([camera.cx, camera.cy]) - scale * (other.cx, other.cy)
    if scale.min() < 1:
        picture = cv2.GaussianBlur(picture, (0, 0), 0.5 / scale.min())
    # resamples to the intrinsics of this view; the coordinates are mapped back below
    warp = np.array([[scale[0], 0, shift[0] + scale[0] / 2 - 0.5], [0, scale[1], shift[1] + scale[1] / 2 - 0.5]])
    resampled = cv2.warpAffine(picture, warp, (camera.width, camera.height), borderMode=cv2.BORDER_REPLICATE)
    places, seen = _follow_flow(gray, _flow(gray, resampled), _flow(resampled, gray), cell)
    places = (places - shift) / scale
    return places, seen & ((places > 0) & (places < (other.width, other.height))).all(-1)


def _follow_flow(gray: np.ndarray, forward: np.ndarray, back: np.ndarray, cell: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates [P, 2] in the other view of one pixel per cell, and which of them are valid, bool [P]."""
    pixels = _pixels(gray, cell)
    columns, rows = pixels.astype(int).transpose(2, 0, 1)
    moved = forward[rows, columns]
    at = (pixels + moved - 0.5).astype(np.float32)
    # 1e6: outside the picture, backward flow never leads back to the pixel
    returned = cv2.remap(back, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1e6,) * 4)
    agree = np.linalg.norm(moved + returned, axis=-1) < ROUND_TRIP
    # the backward flow must lead back, and the picture must have contrast around the pixel
    seen = (_local_contrast(gray)[rows, columns] > LEAST_CONTRAST) & agree
    return (pixels + moved).reshape(-1, 2), seen.reshape(-1)


def _local_contrast(gray: np.ndarray) -> np.ndarray:
    """Return [H, W], the standard deviation of gray levels in a window of 9 x 9 pixels around each pixel."""
    wide = gray.astype(np.float32)
    return np.sqrt(np.maximum(cv2.blur(wide**2, (9, 9)) - cv2.blur(wide, (9, 9)) ** 2, 0))


# ---------------------------------------------------------------------------------------------- depth


def depths_from_matches(matches: Matches, cameras: Mapping[str, Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Compute the depths of a view's pixels from their matches in neighboring views.

    Let R and t be the rotation and translation from this view to a neighbor, and let a pixel's ray have z = 1. The
    point of inverse depth r on the ray is R ray + r t in the neighbor, up to scale. Its reprojection error times its
    depth in the neighbor is linear in r. So each neighbor proposes an r. The proposal with which most neighbors
    agree (reprojection error in x and in y below `RESIDUAL` px) is refined by least squares over the neighbors that
    agree.

    Args:
        cameras: view name -> camera, of the view and its neighbors.

    Returns:
        Depth [P], very large if there is no parallax; and bool [P], True if the depth is reliable: at
        least two neighbors agree (one, if there is only one), and the point is not clearly behind the camera.
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
            a / np.maximum(_neighbor_depth(line, inverse), 1e-3) ** 2 for line, a in zip(lines, agree, strict=True)
        ]
        inverse, square = _solve_inverse_depth(lines, weights)
    known = (np.sum(agree, 0) >= min(2, len(lines))) & (inverse > -2 * NOISE / np.sqrt(square))
    return 1 / np.maximum(inverse, 1e-9), known


def flow_residuals(matches: Matches, cameras: Mapping[str, Camera], depth: np.ndarray) -> np.ndarray:
    """Return the residual vectors [K, P, 2] in pixels of a view's points in its K neighbors.

    A vector leads from the pixel that flow found in the neighbor to the projection of the point there, also where the
    match is not valid (`Matches.seen`). The vector is NaN if the point is behind the neighbor.

    Args:
        depth: [P], depths of the pixels of `matches`; the points lie there on their rays.
    """
    found = []
    for line in _reprojection_lines(matches, cameras):
        z = _neighbor_depth(line, 1 / depth)
        z = np.where(z > 1e-3, z, np.nan)
        found.append((line.slope / depth[:, None] + line.offset) / z[:, None])
    return np.array(found).reshape(len(matches.others), len(depth), 2)


class _ReprojectionLine(NamedTuple):
    """The residuals in one neighbor of P points on the rays of a view's pixels, as functions of inverse depth.

    At inverse depth r the residual vector, in pixels, is (slope r + offset) / (z + shift r). The denominator is the
    point's depth in the neighbor over its depth in the view.
    """

    slope: np.ndarray  # [P, 2]
    offset: np.ndarray  # [P, 2]
    z: np.ndarray  # [P]
    shift: float


def _reprojection_lines(matches: Matches, cameras: Mapping[str, Camera]) -> list[_ReprojectionLine]:
    """Return the residuals of the matched pixels in each neighbor as functions of inverse depth."""
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


def _neighbor_depth(line: _ReprojectionLine, inverse: np.ndarray) -> np.ndarray:
    """Return [P], each point's depth in the neighbor over its depth in this view, at inverse depths [P]."""
    return line.z + line.shift * inverse


def _agrees(line: _ReprojectionLine, inverse: np.ndarray) -> np.ndarray:
    """Return whether each point is in front of the neighbor and within `RESIDUAL` px of its match in x and y, [P]."""
    z = _neighbor_depth(line, inverse)
    miss_x, miss_y = np.abs(line.slope * inverse[:, None] + line.offset).T  # numpy is slow to reduce an axis of 2
    return (z > 1e-3) & (np.maximum(miss_x, miss_y) < RESIDUAL * z)


def _solve_inverse_depth(lines: Sequence[_ReprojectionLine], weights: Sequence) -> tuple[np.ndarray, np.ndarray]:
    """Return the least-squares inverse depths [P], and the denominator [P], the weighted sum of squared slopes."""
    # If each weight is one over the squared depth in the neighbor, the variance of the inverse depth is the variance
    # of flow in px^2 divided by this denominator.
    square = sum(_dot(line.slope, line.slope) * weight for line, weight in zip(lines, weights, strict=True))
    square = np.maximum(square, 1e-12)
    return -sum(_dot(line.slope, line.offset) * w for line, w in zip(lines, weights, strict=True)) / square, square


def _dot(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return one[:, 0] * other[:, 0] + one[:, 1] * other[:, 1]


# ---------------------------------------------------------------------------------------------- points


def locate_cells(camera: Camera, points: np.ndarray, cell: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of the cell in which a view shows each point, row by row, -1 if in none; and the points' depths.

    Args:
        points: [P, 3] in the world.
        cell: side of a cell in pixels. The last cells may reach beyond the picture.

    Returns:
        Indices int [P], and depths [P], camera z, which are not positive behind the camera.
    """
    local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    cells, front = np.full(len(local), -1), np.flatnonzero(local[:, 2] > 1e-3)
    x, y, z = local[front].T
    column = np.floor((x / z * camera.fx + camera.cx) / cell)
    row = np.floor((y / z * camera.fy + camera.cy) / cell)
    high, wide = cell_grid(camera, cell)
    inside = (column >= 0) & (column < wide) & (row >= 0) & (row < high)
    cells[front[inside]] = (row[inside] * wide + column[inside]).astype(int)
    return cells, local[:, 2]


def depth_of_cells(camera: Camera, points: np.ndarray, cell: int) -> np.ndarray:
    """Return [h, w], the least depth of the points in each cell of a view, infinite where there is none."""
    cells, depth = locate_cells(camera, points, cell)
    shown = cells >= 0
    least = np.full(cell_grid(camera, cell), np.inf)
    np.minimum.at(least.reshape(-1), cells[shown], depth[shown])
    return least


def cell_grid(camera: Camera, cell: int) -> tuple[int, int]:
    """Return the numbers of rows and columns of cells that cover a view."""
    return -(-camera.height // cell), -(-camera.width // cell)


def _is_covered(camera: Camera, points: np.ndarray, pixels: np.ndarray, depth: np.ndarray, cell: int) -> np.ndarray:
    """Return bool [P], True if an existing point is in the pixel's cell, in front of the pixel or at its depth."""
    columns, rows = (pixels // cell).astype(int).T
    nearest = depth_of_cells(camera, points, cell)[rows, columns]
    return nearest < depth * (1 + geometry.SAME_IF_COARSE)


def unproject(camera: Camera, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return the world points [P, 3] at depths [P] on the rays of pixels [P, 2]."""
    local = _rays(camera, pixels) * depth[:, None] - camera.world_to_camera[:3, 3]
    return local @ camera.world_to_camera[:3, :3]


def _rays(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return the camera-frame rays [P, 3] of pixels [P, 2], with z = 1."""
    x, y = (pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], 1)
