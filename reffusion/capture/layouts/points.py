"""Tests whether sparse points are in the frame of the cameras, and of their pictures.

People replace the points of a model by another cloud, or the order of its pictures is lost. Where geometry cannot tell
(a cloud of another scale around the same middle), colours can: the views of a point show its colour.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from reffusion.capture.frame import camera_centers, depths_in_view, nearest_depths
from reffusion.capture.layouts.capture import NO_POINTS, PointCloud, Poses
from reffusion.capture.lens import Lens, to_pixels
from reffusion.io.colmap import ModelPoints
from reffusion.io.images import load_thumbnail

INSIDE = 0.02  # share of the points that the median view must show
FARTHEST = 100.0  # times the cameras' distance from their middle: points further away show no parallax
TRACKED = 0.9  # share of the observations that must lie inside the view that made them
VIEWS, POINTS = 8, 8000  # number of views and points for comparing colours, spread evenly
SIDE = 320  # px, the longer side of the pictures that colours are read from
LEAST_POINTS = 50  # in a view
LEAST_CONTRAST = 6.0  # levels of 255: standard deviation, of points and of picture, from which they can be compared
CELLS, NEARLY = 40, 1.1  # cells along a side; times the nearest depth of a cell, up to which points are visible
# Median correlation under which colours contradict the frame. Right clouds of five captures have .38 to .86; those that
# were scaled by 2, turned, mirrored or moved have up to .31.
CORRELATED = 0.25
GREY = np.full(3, 1 / 3)  # weights of red, green and blue
BETTER = 0.02  # by how much another view's points must fit a picture better than its own


def keep_points_in_frame(
    path: Path, points: PointCloud, poses: Poses, pictures: Mapping[str, Path]
) -> tuple[PointCloud, str | None]:
    """The points, none where they are not in the frame of the poses; and in that case a sentence about it."""
    finite = np.isfinite(points[0]).all(axis=1)
    positions, colors = points[0][finite], points[1][finite]
    refused = NO_POINTS, f"{path}: its points are not in the frame of the cameras and are not used"
    if not len(positions):
        return NO_POINTS, None
    depths = [depths_in_view(positions, poses.world_to_camera[name], lens) for name, lens in poses.lenses.items()]
    if np.median([len(z) for z in depths]) < INSIDE * len(positions):
        return refused
    centers = camera_centers(np.stack([*poses.world_to_camera.values()]))
    apart = np.linalg.norm(centers - centers.mean(0), axis=1).max()
    if apart > 0 and np.median([np.median(z) for z in depths if len(z)]) > FARTHEST * apart:
        return refused
    if _has_contrast(colors @ GREY):
        names = list(pictures)[:: -(-len(pictures) // VIEWS)]
        of_view = lambda n: (read_grey(pictures[n]), poses.lenses[n], poses.world_to_camera[n])
        fits = np.array([correlate_colors(*of_view(name), positions, colors) for name in names])
        if (known := ~np.isnan(fits)).any() and np.median(fits[known]) < CORRELATED:
            return refused
    return (positions, colors), None


def are_tracks_inside(points: ModelPoints, poses: Mapping[int, tuple[Lens, np.ndarray]]) -> bool:
    """Do the points lie in front of and inside the images that their tracks name? True where no tracks are known.

    Args:
        poses: image id -> its lens and [4, 4] world-to-camera.
    """
    inside = seen = 0
    for identity, (lens, pose) in poses.items():
        mine = points.positions[points.track_points[points.track_images == identity]]
        inside += len(depths_in_view(mine, pose, lens))
        seen += len(mine)
    return inside >= TRACKED * seen


def contradicts_order(
    pictures: Sequence[Path], lenses: Sequence[Lens], poses: Sequence[np.ndarray], points: PointCloud
) -> bool:
    """Do most of the pictures show the points where another view's pose projects them, rather than their own?

    Args:
        pictures, lenses, poses: view k has pictures[k], lenses[k] and the [4, 4] world-to-camera poses[k].
    """
    if not _has_contrast(points[1] @ GREY):
        return False
    chosen = range(0, len(pictures), -(-len(pictures) // VIEWS))
    misplaced = compared = 0
    for k in chosen:
        grey = read_grey(pictures[k])
        fits = np.array([correlate_colors(grey, lens, pose, *points) for lens, pose in zip(lenses, poses, strict=True)])
        if np.isnan(fits[k]) or np.isnan(fits).sum() > len(fits) / 2:
            continue
        compared += 1
        misplaced += np.nanmax(fits) > fits[k] + BETTER
    return bool(compared) and 2 * misplaced > compared


def correlate_colors(
    grey: np.ndarray, lens: Lens, pose: np.ndarray, positions: np.ndarray, colors: np.ndarray
) -> float:
    """Correlation of the points' brightness with a picture's at their projections; NaN with too few points or contrast.

    Args:
        grey: [H, W] of any size. lens: of the same view at any size. pose: [4, 4] world-to-camera.
        positions: [P, 3]. colors: uint8 [P, 3].
    """
    some = slice(None, None, max(1, len(positions) // POINTS))
    at = positions[some] @ pose[:3, :3].T + pose[:3, 3]
    own, at = colors[some][at[:, 2] > 1e-9] @ GREY, at[at[:, 2] > 1e-9]
    with np.errstate(all="ignore"):
        uv = to_pixels(at[:, :2] / at[:, 2:], lens) / (lens.width, lens.height)
        inside = ((uv > 0) & (uv < 1)).all(axis=1)
    uv, depth, own = uv[inside], at[inside, 2], own[inside]
    front = _is_nearest(uv, depth)
    columns, rows = (uv[front] * grey.shape[::-1]).astype(int).T
    seen, own = grey[rows, columns], own[front]
    if len(own) < LEAST_POINTS or not (_has_contrast(seen) and _has_contrast(own)):
        return float("nan")
    return float(np.corrcoef(seen, own)[0, 1])


def _is_nearest(uv: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """bool [P]: points not hidden by others in the same of `CELLS` x `CELLS` cells of the picture [0, 1]^2."""
    cells = (uv * CELLS).astype(int) @ (CELLS, 1)
    return depth < NEARLY * nearest_depths(cells, depth)


def read_grey(path: Path) -> np.ndarray:
    """float64 [h, w], at most `SIDE` px."""
    return load_thumbnail(path, SIDE) @ GREY


def _has_contrast(values: np.ndarray) -> bool:
    return len(values) > 0 and float(values.std()) > LEAST_CONTRAST
