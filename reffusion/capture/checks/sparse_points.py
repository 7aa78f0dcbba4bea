"""Tests whether sparse points are in the same frame as the cameras, and whether pictures belong to their poses.

Users replace the points of a model by another point cloud, or lose the order of its pictures. Geometry alone does not
reveal every such mistake, for example a cloud of another scale around the same middle. Colors do: at a point's
projection, a picture shows the point's color.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from reffusion.capture.layouts.capture import NO_POINTS, PointCloud, Poses
from reffusion.capture.lens import Lens, to_pixels
from reffusion.capture.normalized_frame import camera_centers, depths_in_view, nearest_depths
from reffusion.io.colmap import ModelPoints
from reffusion.io.images import load_thumbnail

INSIDE = 0.02  # share of the points that must lie inside the picture of the median view
FARTHEST = 100.0  # times the largest distance of a camera from the cameras' mean: farther points have no parallax
TRACKED = 0.9  # share of the observations whose points must lie inside the observing view
VIEWS, POINTS = 8, 8000  # about how many views and points, spread evenly, are used to compare colors
SIDE = 320  # px, longer side of the reduced pictures from which colors are read
LEAST_POINTS = 50  # visible points that a view needs for the comparison
LEAST_CONTRAST = 6.0  # levels of 255: smallest standard deviation of the points' brightness, and of the picture's
CELLS, NEARLY = 40, 1.1  # cells along each side; points up to this many times the nearest depth of a cell are visible
# Median correlation, below which colors contradict the frame. Right point clouds of five captures have .38 to .86; the
# same clouds scaled by 2, turned, mirrored or moved have up to .31.
CORRELATED = 0.25
GRAY = np.full(3, 1 / 3)  # weights of red, green and blue


def keep_points_in_frame(
    path: Path, points: PointCloud, poses: Poses, pictures: Mapping[str, Path]
) -> tuple[PointCloud, str | None]:
    """Return the points if they are in the frame of the poses, else no points.

    The points are refused if too few lie inside the pictures, if they are very far away, or if the pictures do not show
    their colors. Points that are not finite are dropped.

    Args:
        path: file of the points, for the message.
        points: positions [P, 3] and colors [P, 3]; P may be 0.
        pictures: view name -> picture file.

    Returns:
        The finite points, or no points; and a message to the user if points were refused, else None.
    """
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
    if _has_contrast(colors @ GRAY):
        placed = [name for name in pictures if name in poses.lenses]  # a correction may leave out views
        names = placed[:: -(-len(placed) // VIEWS)]
        of_view = lambda n: (read_gray(pictures[n]), poses.lenses[n], poses.world_to_camera[n])
        fits = np.array([correlate_colors(*of_view(name), positions, colors) for name in names])
        if (known := ~np.isnan(fits)).any() and np.median(fits[known]) < CORRELATED:
            return refused
    return (positions, colors), None


def are_tracks_inside(points: ModelPoints, poses: Mapping[int, tuple[Lens, np.ndarray]]) -> bool:
    """Return whether at least 90% of the observations (`TRACKED`) have a point inside the observing image.

    Args:
        points: points and tracks of a COLMAP model.
        poses: image id -> its lens and its world-to-camera pose [4, 4]. Observations by other images are ignored. If
            there are no observations by these images, the result is True.
    """
    inside = seen = 0
    for identity, (lens, pose) in poses.items():
        mine = points.positions[points.track_points[points.track_images == identity]]
        inside += len(depths_in_view(mine, pose, lens))
        seen += len(mine)
    return inside >= TRACKED * seen


def correlate_colors(
    gray: np.ndarray, lens: Lens, pose: np.ndarray, positions: np.ndarray, colors: np.ndarray
) -> float:
    """Correlate the brightness of points with that of a picture at the points' projections.

    Args:
        gray: [H, W] in [0, 255], brightness of the picture, at any size.
        lens: lens of the view, at any size.
        pose: [4, 4], world-to-camera pose of the view.
        positions: [P, 3].
        colors: uint8 [P, 3].

    Returns:
        Pearson's correlation in [-1, 1] over those of about `POINTS` points that lie in the picture and that no clearly
        nearer point hides; NaN if there are too few of them or too little contrast.
    """
    some = slice(None, None, max(1, len(positions) // POINTS))
    at = positions[some] @ pose[:3, :3].T + pose[:3, 3]
    own, at = colors[some][at[:, 2] > 1e-9] @ GRAY, at[at[:, 2] > 1e-9]
    with np.errstate(all="ignore"):
        uv = to_pixels(at[:, :2] / at[:, 2:], lens) / (lens.width, lens.height)
        inside = ((uv > 0) & (uv < 1)).all(axis=1)
    uv, depth, own = uv[inside], at[inside, 2], own[inside]
    front = _is_nearest(uv, depth)
    columns, rows = (uv[front] * gray.shape[::-1]).astype(int).T
    seen, own = gray[rows, columns], own[front]
    if len(own) < LEAST_POINTS or not (_has_contrast(seen) and _has_contrast(own)):
        return float("nan")
    return float(np.corrcoef(seen, own)[0, 1])


def _is_nearest(uv: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return bool [P], True if no point in the same cell is clearly nearer; `uv` [P, 2]: shares of width, height."""
    cells = (uv * CELLS).astype(int) @ (CELLS, 1)
    return depth < NEARLY * nearest_depths(cells, depth)


def read_gray(path: Path) -> np.ndarray:
    """Read a picture as gray float64 [h, w] in [0, 255] (mean of its colors), at most `SIDE` px on the longer side."""
    return load_thumbnail(path, SIDE) @ GRAY


def _has_contrast(values: np.ndarray) -> bool:
    """Return whether the standard deviation of brightnesses exceeds `LEAST_CONTRAST`."""
    return len(values) > 0 and float(values.std()) > LEAST_CONTRAST
