"""Initial points where a view shows what no match between views places in space.

Forest behind a trunk that one photograph shows, or the bark at its border, has no sparse point and no flow. A fit would
have to grow Gaussians across such areas from their rims, and a short one leaves flat color or long needles there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt, median_filter

from reffusion.capture.flow import FARTHEST, depth_of_cells, locate_cells, unproject
from reffusion.geometry import SAME_IF_COARSE
from reffusion.types import Camera

CELL = 6  # px: a point is added for each empty cell of this side
REACH = 3  # cells: one that is nearer than this to a cell with a point needs no point of its own
SMOOTHING = 5  # cells: side of the window in which the depth of cells with points is a median
FARTHER = 1.5  # factor by which a point moves away while another view sees past it
MAX_WITNESSES = 24  # number of views that are asked, so that time grows linearly with the views
# No point is placed nearer to a camera than this share of the depth that all but `NEAREST` percent of its view's cells
# exceed, in any direction. Where no view looks, points would stand as fog before the cameras of new views (LOG.md).
FREE_SHARE, NEAREST = 0.5, 5


def points_for_empty_cells(
    cameras: Sequence[Camera], images: Mapping[str, np.ndarray], points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return new points for the cells of each view that show no point and are `REACH` or more cells from one that does.

    A new point has the smoothed depth of the nearest cell that shows a point, times powers of `FARTHER` until none of
    `MAX_WITNESSES` views sees past it and none of their cameras is near (`FREE_SHARE`); the depth is limited to
    `FARTHEST`. New points count as shown in later views. A view that shows no point at all gets none.

    Args:
        cameras: the views, in the normalized frame.
        images: view name -> uint8 [H, W, 3].
        points: [P, 3], the points that matches have placed.

    Returns:
        The new points [A, 3] float64 and their colors [A, 3] uint8, without `points`.
    """
    witnesses = cameras[:: -(-len(cameras) // MAX_WITNESSES)]
    seen = {camera.name: depth_of_cells(camera, points, CELL) for camera in cameras}
    added, colors = np.empty((0, 3)), [np.empty((0, 3), np.uint8)]
    for camera in cameras:
        depth = np.minimum(seen[camera.name], depth_of_cells(camera, added, CELL))
        shown = np.isfinite(depth)
        if not shown.any():
            continue
        away, nearest = distance_transform_edt(~shown, return_indices=True)
        smooth = median_filter(depth[tuple(nearest)], SMOOTHING)
        rows, columns = np.nonzero(away >= REACH)
        pixels = np.stack([(columns + 0.5) * CELL, (rows + 0.5) * CELL], 1)
        inside = (pixels < (camera.width, camera.height)).all(1)
        pixels, depths = pixels[inside], smooth[tuple(nearest[:, rows[inside], columns[inside]])]
        left = np.arange(len(depths))
        while len(left := left[_is_in_free_space(unproject(camera, pixels[left], depths[left]), witnesses, seen)]):
            depths[left] *= FARTHER
            left = left[depths[left] < FARTHEST]
        added = np.concatenate([added, unproject(camera, pixels, np.minimum(depths, FARTHEST))])
        columns, rows = pixels.astype(int).T
        colors.append(cv2.blur(images[camera.name], (CELL, CELL))[rows, columns])
    return added, np.concatenate(colors)


def _is_in_free_space(points: np.ndarray, cameras: Sequence[Camera], seen: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return bool [P], True for points that a camera sees past (by the depths in `seen`), or that are near a camera."""
    free = np.zeros(len(points), bool)
    for camera in cameras:
        cells, depth = locate_cells(camera, points, CELL)
        inside = np.flatnonzero(cells >= 0)
        behind = seen[camera.name].reshape(-1)[cells[inside]]
        free[inside] |= np.isfinite(behind) & (depth[inside] < behind * (1 - SAME_IF_COARSE))
        if len(known := seen[camera.name][np.isfinite(seen[camera.name])]):
            free |= np.linalg.norm(points - camera.center, axis=1) < FREE_SHARE * np.percentile(known, NEAREST)
    return free
