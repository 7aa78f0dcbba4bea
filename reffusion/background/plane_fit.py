"""Fit planes to samples of the visible surfaces, and refine them by sparse points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reffusion import geometry, seeding
from reffusion.background.visibility import DepthView
from reffusion.morphology import dilate_by_distance

RING = 0.12  # of the image's width: how far around the masks surfaces are sampled
VIEWS = 12  # views that are sampled
SAMPLES = 1500  # samples of each view
TRIALS = 300  # RANSAC trials for each plane
# Sparse points refine a plane in steps, each with a smaller inlier distance, as fractions of that of the samples.
# MIN_INLIERS points must lie within the last distance, and they must be at least MIN_SHARPNESS of those within the
# whole distance (a quarter of them would where there is no plane). MAX_TURN is the cosine of the largest turn they may
# cause.
INLIER_STEPS, MIN_INLIERS, MIN_SHARPNESS, MAX_TURN = (1.0, 0.5, 0.25), 50, 0.5, 0.98


def sample_surfaces(center: np.ndarray, radius: float, views: Sequence[DepthView], seed: int) -> np.ndarray:
    """[S, 3] points of the surfaces that views show around their masks, within `radius` of `center`."""
    generator, found = np.random.default_rng(seeding.seed_for(seed, "surfaces around")), [np.zeros((0, 3))]
    for view in views[:: max(1, len(views) // VIEWS)]:
        rows, columns = np.nonzero(dilate_by_distance(view.masked, RING) & ~view.masked & (view.depth > 0))
        if len(rows):
            chosen = generator.choice(len(rows), min(SAMPLES, len(rows)), replace=False)
            found.append(geometry.unproject(view.depth, view.camera)[rows[chosen], columns[chosen]])
    points = np.concatenate(found)
    return points[np.linalg.norm(points - center, axis=1) < radius]


def ransac_plane(
    points: np.ndarray, inlier_distance: float, generator: np.random.Generator
) -> tuple[np.ndarray, float, int]:
    """Normal, offset and number of inliers of the plane with most inliers, refitted to them."""
    first, second, third = (points[generator.integers(len(points), size=TRIALS)] for _ in range(3))
    normals = np.cross(second - first, third - first)
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 1e-12] / length[length > 1e-12, None]
    if not len(normals):
        return np.array([0.0, 0.0, 1.0]), 0.0, 0
    offsets = (normals * first[length > 1e-12]).sum(1)
    inliers = (np.abs(points @ normals.T - offsets) < inlier_distance).sum(0)
    normal, offset = normals[inliers.argmax()], offsets[inliers.argmax()]
    normal, offset = _refit(normal, offset, points, inlier_distance)
    return normal, offset, int((np.abs(points @ normal - offset) < inlier_distance).sum())


def refine_by_points(
    normal: np.ndarray, offset: float, points: np.ndarray, inlier_distance: float, min_spread: float
) -> tuple[np.ndarray, float] | None:
    """Normal and offset of the plane, refitted to the sparse points [P, 3] near it.

    None unless there are enough, they spread in all directions, and they lie sharply on the plane: grass is no plane,
    though some of its points lie on any. Rendered depth is biased towards the camera wherever haze hangs before a
    plain surface, the more the more oblique the view; this turns a plane by a degree or more.

    Args:
        inlier_distance: distance within which a sample of the rendered surface belongs to the plane.
        min_spread: least standard deviation of the points, in the direction in which they spread least.
    """
    new_normal, new_offset = normal, offset
    for share in INLIER_STEPS:
        new_normal, new_offset = _refit(new_normal, new_offset, points, share * inlier_distance)
    distance = np.abs(points @ new_normal - new_offset)
    inliers = points[distance < INLIER_STEPS[-1] * inlier_distance]
    enough = max(MIN_INLIERS, MIN_SHARPNESS * (distance < inlier_distance).sum())
    if len(inliers) < enough or abs(new_normal @ normal) < MAX_TURN:
        return None
    spread = np.linalg.svd(inliers - inliers.mean(0), compute_uv=False)[1] / np.sqrt(len(inliers))
    return (new_normal, new_offset) if spread > min_spread else None


def _refit(normal: np.ndarray, offset: float, points: np.ndarray, inlier_distance: float) -> tuple[np.ndarray, float]:
    """Normal and offset of the plane, refitted five times by least squares to its inliers."""
    for _ in range(5):
        inliers = points[np.abs(points @ normal - offset) < inlier_distance]
        if len(inliers) < 3:
            break
        middle = inliers.mean(0)
        normal = np.linalg.svd(inliers - middle, full_matrices=False)[2][2]
        offset = float(middle @ normal)
    return normal, float(offset)
