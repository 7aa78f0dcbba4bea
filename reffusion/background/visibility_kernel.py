"""What one view says of many points in space, compiled: scenes are asked of millions of points in all their views."""

from __future__ import annotations

import numpy as np

from reffusion.kernels.compiled import kernel, parallel_for
from reffusion.kernels.vectors import take_ticket
from reffusion.types import Camera

SEEN, FREE, BEHIND, HIDDEN = range(4)  # rows of the counts, see `masks.witness.Votes`
SHARES = 65535  # what a share of 1 is kept as
_CHUNK = 2048  # points that a thread takes at once


def ask(
    points: np.ndarray,
    normals: np.ndarray | None,
    camera: Camera,
    shown: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    margins: tuple[float, float],
    counts: np.ndarray,
) -> None:
    """Add 1 to what a view says of each point.

    Args:
        points: [P, 3] float64. normals: [P, 3] or None, see `masks.witness.votes`.
        shown: of a witness `depth`, `closer`, `farther` and `hidden`.
        margins: relative depth within which a point is on the surface, and beyond which the view looks past it.
        counts: [4, P] int64, changed in place.
    """
    facing = np.empty((0, 3)) if normals is None else np.ascontiguousarray(normals, np.float64)
    inner = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    pose, centre = np.ascontiguousarray(camera.world_to_camera, np.float64), np.asarray(camera.center, np.float64)
    arrays = tuple(np.ascontiguousarray(each) for each in shown)
    points = np.ascontiguousarray(points, np.float64)
    parallel_for(_ask, points, facing, inner, pose, centre, *arrays, *margins, counts, gaussians=len(points))


@kernel
def _ask(tickets, points, normals, inner, pose, centre, depth, closer, farther, hidden, surface, free, counts):
    height, width = hidden.shape
    fx, fy, cx, cy = inner
    # Depth maps are compared in their own precision.
    before, after = np.float32(1 - surface), np.float32(1 + surface)
    while True:
        begin = take_ticket(tickets) * _CHUNK
        if begin >= len(points):
            return
        for i in range(begin, min(begin + _CHUNK, len(points))):
            x, y, z = points[i]
            ahead = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
            if not ahead > 0:
                continue
            u = fx * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / ahead + cx
            v = fy * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / ahead + cy
            if not (u >= 0 and u < width and v >= 0 and v < height):
                continue
            row, column = int(v), int(u)
            if hidden[row, column]:
                counts[HIDDEN, i] += 1
                continue
            near = depth[row, column] * (np.float32(closer[row, column]) / np.float32(SHARES))
            far = depth[row, column] * (np.float32(SHARES) / np.float32(max(farther[row, column], 1)))
            if not near > 0:
                continue
            faced = True
            if len(normals):
                nx, ny, nz = normals[i]
                faced = (centre[0] - x) * nx + (centre[1] - y) * ny + (centre[2] - z) * nz > 0
            counts[SEEN, i] += faced and ahead > near * before and ahead < far * after
            counts[FREE, i] += near > ahead * (1 + free)
            counts[BEHIND, i] += faced and ahead > far * after
