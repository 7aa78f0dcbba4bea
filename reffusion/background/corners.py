"""The third face of a corner: oblique views give it few samples, but two planes at right angles fix its direction."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from reffusion import geometry
from reffusion.background.plane import IN_FRONT, Plane
from reffusion.background.visibility import DepthView

MAX_COSINE = 0.2  # between two normals up to which they may be two faces of a box or a room
REACH = 0.75  # of the object's radius: how far from its middle the third face may pass
MIN_SAMPLES, MIN_SHARE = 50, 0.01  # samples that the face must explain, and their share of all samples
SHARPNESS = 4.0  # times as many samples as in the slabs beside it: no face in a cloud of leaves is that sharp
STEPS = 4  # offsets that are tried within a plane's thickness


def find_third_faces(
    samples: np.ndarray,
    unexplained: np.ndarray,
    planes: Sequence[tuple[np.ndarray, float]],
    center: np.ndarray,
    radius: float,
    inlier_distance: float,
) -> list[tuple[np.ndarray, float]]:
    """(normal, offset) of the planes at right angles to two of `planes` that samples show sharply.

    With the direction fixed, few samples determine the offset. RANSAC over three samples would find a hundred planes
    that are as good.

    Args:
        samples: [S, 3]. unexplained: bool [S], samples on none of the planes.
        planes: (normal, offset) of those found.
        center: [3], the middle of the removed object; radius: the radius of most of it.
        inlier_distance: distance within which a sample belongs to a plane.
    """
    enough, faces = max(MIN_SAMPLES, MIN_SHARE * len(samples)), []
    for (one, _), (other, _) in combinations(planes, 2):
        if abs(one @ other) > MAX_COSINE:
            continue
        normal = np.cross(one, other)
        normal /= np.linalg.norm(normal)
        if any(abs(normal @ known) > 1 - MAX_COSINE for known, _ in faces):
            continue
        position = np.sort((samples[unexplained] - center) @ normal)
        count = lambda low, high, position=position: np.searchsorted(position, high) - np.searchsorted(position, low)
        tried = np.arange(-REACH * radius, REACH * radius, inlier_distance / STEPS)
        support = count(tried - inlier_distance, tried + inlier_distance)
        best = support.argmax()
        at = tried[best]
        beside = max(
            count(at - 3 * inlier_distance, at - inlier_distance), count(at + inlier_distance, at + 3 * inlier_distance)
        )
        if support[best] >= enough and support[best] > SHARPNESS * beside:
            inliers = position[count(-np.inf, at - inlier_distance) : count(-np.inf, at + inlier_distance)]
            faces.append((normal, float(np.median(inliers) + center @ normal)))
    return faces


def visible_past(plane: Plane, nearer: Sequence[Plane], views: Sequence[DepthView]) -> np.ndarray:
    """bool [CELLS, CELLS]: cells that the object occludes in some view, and that this view would see past everything
    that is known of the `nearer` planes: the face of a box does not continue inside the box."""
    points, found = plane.cell_centers.reshape(-1, 3), np.zeros(plane.seen.size, bool)
    for view in views:
        uv, z = geometry.project(points, view.camera)
        masked, inside = geometry.sample_nearest(view.masked, uv)
        candidates = np.nonzero(inside & masked & (z > 0) & ~found)[0]
        rays, clear = points[candidates] - view.camera.center, np.ones(len(candidates), bool)
        for other in nearer:
            with np.errstate(divide="ignore", invalid="ignore"):
                distance = (other.offset - view.camera.center @ other.normal) / (rays @ other.normal)
            meets = (distance > 0) & (distance < IN_FRONT)
            hit = view.camera.center + rays * np.where(meets, distance, 0)[:, None]
            clear &= ~(meets & other.contains(other.seen | other.continued, hit))
        found[candidates[clear]] = True
    return found.reshape(plane.seen.shape)
