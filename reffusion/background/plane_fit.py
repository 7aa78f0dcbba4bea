"""Planes through samples of the surfaces that views show, and where sparse points say they are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reffusion import geometry, seeding
from reffusion.background.visibility import Witness
from reffusion.depth.background_depth import grown

RING = 0.12  # of the image's width: how far around the masks surfaces are sampled
VIEWS = 12  # views that are sampled
SAMPLES = 1500  # of each
TRIALS = 300  # draws of three samples for each plane
# Of the distance within which a sample belongs to a plane, that within which a sparse point does, step by step; how
# many must; their share of those within all of it, a quarter where no plane is; and the cosine of the angle by which
# they may turn it.
CLOSER, TELLING, SHARP, TURNED = (1.0, 0.5, 0.25), 50, 0.5, 0.98


def surface_samples(centre: np.ndarray, reach: float, views: Sequence[Witness], seed: int) -> np.ndarray:
    """[S, 3] points of the surfaces that views show around their masks, within reach."""
    draws, found = np.random.default_rng(seeding.seed_for(seed, "surfaces around")), [np.zeros((0, 3))]
    for view in views[:: max(1, len(views) // VIEWS)]:
        rows, columns = np.nonzero(grown(view.hidden, RING) & ~view.hidden & (view.depth > 0))
        if len(rows):
            chosen = draws.choice(len(rows), min(SAMPLES, len(rows)), replace=False)
            found.append(geometry.unproject(view.depth, view.camera)[rows[chosen], columns[chosen]])
    points = np.concatenate(found)
    return points[np.linalg.norm(points - centre, axis=1) < reach]


def best_plane(points: np.ndarray, near: float, draws: np.random.Generator) -> tuple[np.ndarray, float, int]:
    """Normal, height and support of the plane through three of the points that most are near to, fitted to its own."""
    first, second, third = (points[draws.integers(len(points), size=TRIALS)] for _ in range(3))
    normals = np.cross(second - first, third - first)
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 1e-12] / length[length > 1e-12, None]
    if not len(normals):
        return np.array([0.0, 0.0, 1.0]), 0.0, 0
    heights = (normals * first[length > 1e-12]).sum(1)
    support = (np.abs(points @ normals.T - heights) < near).sum(0)
    normal, height = normals[support.argmax()], heights[support.argmax()]
    normal, height = _settled(normal, height, points, near)
    return normal, height, int((np.abs(points @ normal - height) < near).sum())


def told(
    normal: np.ndarray, height: float, points: np.ndarray, near: float, spread: float
) -> tuple[np.ndarray, float] | None:
    """Normal and height of the plane through the sparse points [P, 3] near to it; None unless they are enough, lie to
    all sides, and sharply on it: grass is no plane, though some of its points lie on any.

    What is rendered lies too near wherever haze hangs before a plain surface, the more the more it is seen at a slant;
    that turns a plane by a degree or more.

    Args:
        near: distance within which a sample belongs to the plane.
        spread: of the points from their middle, in the direction in which they spread least.
    """
    turned, moved = normal, height
    for share in CLOSER:
        turned, moved = _settled(turned, moved, points, share * near)
    away = np.abs(points @ turned - moved)
    own = points[away < CLOSER[-1] * near]
    if len(own) < max(TELLING, SHARP * (away < near).sum()) or abs(turned @ normal) < TURNED:
        return None
    narrowest = np.linalg.svd(own - own.mean(0), compute_uv=False)[1] / np.sqrt(len(own))
    return (turned, moved) if narrowest > spread else None


def _settled(normal: np.ndarray, height: float, points: np.ndarray, near: float) -> tuple[np.ndarray, float]:
    """Normal and height of the plane, fitted in turns to the points near to it."""
    for _ in range(5):
        own = points[np.abs(points @ normal - height) < near]
        if len(own) < 3:
            break
        middle = own.mean(0)
        normal = np.linalg.svd(own - middle, full_matrices=False)[2][2]
        height = float(middle @ normal)
    return normal, float(height)
