"""The third face of a corner, e.g. of a box or a room, found from its two other faces.

Views often show this face obliquely, so few samples of visible surfaces lie on it. But two planes at right angles
determine its normal.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from reffusion import geometry
from reffusion.background.plane import IN_FRONT, Plane
from reffusion.background.visibility import DepthView

MAX_COSINE = 0.2  # cosine between two normals up to which their planes may be two faces of a box or a room
REACH = 0.75  # of the object's radius: largest distance of the third face from the middle of the object
MIN_SAMPLES, MIN_SHARE = 50, 0.01  # least number of samples on the face, and least share of all samples
# A face must have more than this many times the samples of the equally thick slabs beside it. A cloud of leaves has no
# slab with so many samples.
SHARPNESS = 4.0
STEPS = 4  # number of offsets that are tried within the distance of an inlier


def find_third_faces(
    samples: np.ndarray,
    unexplained: np.ndarray,
    planes: Sequence[tuple[np.ndarray, float]],
    center: np.ndarray,
    radius: float,
    inlier_distance: float,
) -> list[tuple[np.ndarray, float]]:
    """Find the planes at right angles to two of the given planes on which many of the unexplained samples lie sharply.

    The two given planes must be about at right angles to each other. The normal of a third plane is then known, so few
    samples suffice to determine its offset. RANSAC, which draws three samples per plane, would find a hundred planes
    with as many inliers.

    Args:
        samples: [S, 3], points of the visible surfaces around the object.
        unexplained: bool [S], True for samples that lie on none of the planes.
        planes: the planes found so far, each (normal [3], offset), with normal . x = offset.
        center: [3], the middle of the removed object.
        radius: radius around the center that contains most of the removed object.
        inlier_distance: distance within which a sample belongs to a plane, in world units.

    Returns:
        (normal, offset) of each plane found. None of them is about parallel to another, and each passes within
        about `REACH` radii of the center.
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
    """Return the cells of a plane that the object hides in some view, and that this view would show without the object.

    A cell is True if in some view the object's mask covers the cell, and no `nearer` plane occludes the cell. A cell
    that no mask covers is False, even if views show the cell. A plane occludes only with its known cells (seen or
    continued). So the face of a box does not continue inside the box, because there the box's other faces occlude it.

    Args:
        nearer: the planes that may occlude `plane`, with their cells.

    Returns:
        bool [CELLS, CELLS].
    """
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
