"""Fits of planes to samples of the visible surfaces, and their refinement by sparse points.

A plane is given by its unit normal [3] and its offset: it consists of the points x with normal . x = offset.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from reffusion import geometry, seeding
from reffusion.background.visibility import DepthView
from reffusion.morphology import dilate_by_distance

RING = 0.12  # of the image's width: largest distance from the masks at which surfaces are sampled
VIEWS = 12  # approximate number of views that are sampled
SAMPLES = 1500  # largest number of samples of each view
TRIALS = 300  # RANSAC trials for each plane
# Sparse points refine a plane in steps with decreasing inlier distances. INLIER_STEPS are these distances, as fractions
# of the inlier distance of the samples. At least MIN_INLIERS points must lie within the last distance. They must also
# be at least the share MIN_SHARPNESS of the points within the full distance. (If the points lay on no plane, this share
# would be about a quarter.) MAX_TURN is the cosine of the largest angle by which the refinement may turn the plane.
INLIER_STEPS, MIN_INLIERS, MIN_SHARPNESS, MAX_TURN = (1.0, 0.5, 0.25), 50, 0.5, 0.98


def sample_surfaces(center: np.ndarray, radius: float, views: Sequence[DepthView]) -> np.ndarray:
    """Return samples of the visible surfaces: random points of the surfaces that views show around their masks.

    Args:
        center: [3], the middle of the removed object.
        radius: largest distance of a sample from the center.
        views: depth of the training views, rendered with the object.

    Returns:
        [S, 3], world points; S may be 0.
    """
    generator, found = np.random.default_rng(seeding.seed_for(0, "surfaces around")), [np.zeros((0, 3))]
    for view in views[:: max(1, len(views) // VIEWS)]:
        rows, columns = np.nonzero(dilate_by_distance(view.masked, RING) & ~view.masked & (view.depth > 0))
        if len(rows):
            chosen = generator.choice(len(rows), min(SAMPLES, len(rows)), replace=False)
            found.append(geometry.unproject(view.depth, view.camera)[rows[chosen], columns[chosen]])
    points = np.concatenate(found)
    return points[np.linalg.norm(points - center, axis=1) < radius]


def search_planes(
    points: np.ndarray, inlier_distance: float, generator: np.random.Generator, least: float, claimed: float = 1.0
) -> Iterator[tuple[np.ndarray, float]]:
    """Find planes one after the other by RANSAC, roughly in the order of decreasing numbers of inliers.

    Args:
        points: [P, 3].
        inlier_distance: distance from a plane below which a point is an inlier.
        least: number of inliers below which the search ends.
        claimed: later planes use only points at least this many inlier distances from each earlier plane.

    Yields:
        Unit normal [3] of either sign, and offset.
    """
    while len(points) >= max(least, 1):
        normal, offset, inliers = _ransac_plane(points, inlier_distance, generator)
        if inliers < least:
            return
        yield normal, offset
        points = points[np.abs(points @ normal - offset) >= claimed * inlier_distance]


def _ransac_plane(
    points: np.ndarray, inlier_distance: float, generator: np.random.Generator
) -> tuple[np.ndarray, float, int]:
    """Return the normal [3] and offset of the plane with most inliers, and their number; 0 if there is no plane."""
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
    """Refit a plane to the sparse points near it; it was fitted to rendered depth before.

    Rendered depth is biased towards the camera wherever faint Gaussians float before a plain surface, the more so the
    more oblique the view. This may turn a plane by a degree or more.

    Args:
        normal, offset: the plane.
        points: [P, 3], sparse points, also far from the plane.
        inlier_distance: distance within which a sample of the rendered surface belongs to the plane.
        min_spread: least standard deviation of the points within the plane, in the direction in which they spread
            least.

    Returns:
        Normal [3] and offset of the refitted plane. None if too few points lie near the plane, if they do not spread in
        both directions of the plane, if they do not lie sharply on the plane (grass is no plane, although some of its
        points lie near any plane), or if the plane would turn too far.
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
    """Refit a plane to its inliers by least squares, five times; stop if there are fewer than three inliers."""
    for _ in range(5):
        inliers = points[np.abs(points @ normal - offset) < inlier_distance]
        if len(inliers) < 3:
            break
        middle = inliers.mean(0)
        normal = np.linalg.svd(inliers - middle, full_matrices=False)[2][2]
        offset = float(middle @ normal)
    return normal, float(offset)
