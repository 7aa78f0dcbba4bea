"""The compiled kernel of the visibility test (`background.visibility`), for millions of points per view."""

from __future__ import annotations

import numpy as np

from reffusion.kernels.compiled import kernel, parallel_for
from reffusion.kernels.vectors import take_ticket
from reffusion.types import Camera

SEEN, FREE, OCCLUDED, MASKED = range(4)  # rows of the counts, one per class, see `visibility.Visibility`
UNIT_RATIO = 65535  # the uint16 value that represents a ratio of 1
_CHUNK = 2048  # number of points in one piece of a thread's work


def count_in_view(
    points: np.ndarray,
    normals: np.ndarray | None,
    camera: Camera,
    maps: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    margins: tuple[float, float],
    counts: np.ndarray,
) -> None:
    """Classify points in one view, and add 1 to the count of each point's class.

    A point has no class e.g. if it projects outside the image, if it lies behind the camera, or if the view shows
    nothing at its pixel.

    Args:
        points: [P, 3], world coordinates.
        normals: [P, 3] or None, see `visibility.count_views`.
        camera: the view.
        maps: `depth`, `near_ratio`, `far_ratio` and `masked` of a `DepthView`.
        margins: the relative depth within which a point lies on the surface, and the relative depth by which a point in
            free space lies in front of the surface.
        counts: [4, P] int64, the rows are `SEEN`, `FREE`, `OCCLUDED`, `MASKED`; updated in place.
    """
    facing = np.empty((0, 3)) if normals is None else np.ascontiguousarray(normals, np.float64)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    pose, center = np.ascontiguousarray(camera.world_to_camera, np.float64), np.asarray(camera.center, np.float64)
    arrays = tuple(np.ascontiguousarray(each) for each in maps)
    points = np.ascontiguousarray(points, np.float64)
    parallel_for(_classify, points, facing, intrinsics, pose, center, *arrays, *margins, counts, gaussians=len(points))


@kernel
def _classify(
    tickets, points, normals, intrinsics, pose, center, depth, near_ratio, far_ratio, masked, surface, free, counts
):
    """Classify points in one view on several threads, see `count_in_view`; each thread takes chunks of points."""
    height, width = masked.shape
    fx, fy, cx, cy = intrinsics
    # Depth maps are float32, so they are compared in float32.
    before, after = np.float32(1 - surface), np.float32(1 + surface)
    while True:
        begin = take_ticket(tickets) * _CHUNK
        if begin >= len(points):
            return
        for i in range(begin, min(begin + _CHUNK, len(points))):
            x, y, z = points[i]
            point_depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
            if not point_depth > 0:
                continue
            u = fx * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / point_depth + cx
            v = fy * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / point_depth + cy
            if not (u >= 0 and u < width and v >= 0 and v < height):
                continue
            row, column = int(v), int(u)
            if masked[row, column]:
                counts[MASKED, i] += 1
                continue
            near = depth[row, column] * (np.float32(near_ratio[row, column]) / np.float32(UNIT_RATIO))
            far = depth[row, column] * (np.float32(UNIT_RATIO) / np.float32(max(far_ratio[row, column], 1)))
            if not near > 0:
                continue
            is_facing = True
            if len(normals):
                nx, ny, nz = normals[i]
                is_facing = (center[0] - x) * nx + (center[1] - y) * ny + (center[2] - z) * nz > 0
            counts[SEEN, i] += is_facing and point_depth > near * before and point_depth < far * after
            counts[FREE, i] += near > point_depth * (1 + free)
            counts[OCCLUDED, i] += is_facing and point_depth > far * after
