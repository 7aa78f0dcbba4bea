"""Planes beside the object, such as the floor, a table or the top of a plinth, as evidence for what is not the object.

The first masks label only the Gaussians that their views show. Elsewhere a segmentation network may take the object
and what it stands on for one thing, such as a statue and its plinth of the same stone. The labeled part of the plinth
lies on planes. Gaussians without a label on the same planes belong to the plinth, too, until masks of further views
label them.
"""

from __future__ import annotations

from itertools import islice

import numpy as np

from reffusion import seeding
from reffusion.background.plane_fit import search_planes

# Lengths are shares of the object's radius: the 95 % quantile of the distance of its Gaussians from their median.
REACH = 2.0  # Gaussians farther from the object's median are not considered
INLIER_DISTANCE = 0.02
PLANES = 3  # largest number of planes
MIN_SHARE = 0.1  # share of the Gaussians around the object with the label "not the object" that a plane must hold
MAX_OBJECT_SHARE = 0.1  # a plane that holds a larger share of the object's Gaussians is none of its supports
MIN_GAUSSIANS = 20  # least number of the object's Gaussians, and of those of a plane
SAMPLES = 4000  # largest number of Gaussians in which planes are searched


def find_support_gaussians(means: np.ndarray, is_object: np.ndarray, is_other: np.ndarray) -> np.ndarray:
    """Find planes around the object that hold much of the rest of the scene, but little of the object.

    Args:
        means: [N, 3] positions of the Gaussians.
        is_object: bool [N], Gaussians labeled as the object.
        is_other: bool [N], Gaussians labeled as not the object. Gaussians in neither array have no label.

    Returns:
        bool [N], True for the Gaussians on these planes, whatever their label. False far from the object (`REACH`), and
        everywhere if the object has fewer than `MIN_GAUSSIANS` Gaussians.
    """
    found = np.zeros(len(means), bool)
    if is_object.sum() < MIN_GAUSSIANS:
        return found
    center = np.median(means[is_object], 0)
    distance = np.linalg.norm(means - center, axis=1)
    radius = np.quantile(distance[is_object], 0.95)
    near, generator = distance < REACH * radius, np.random.default_rng(seeding.seed_for(0, "supports"))
    points = means[near & is_other]
    points = points[generator.permutation(len(points))[:SAMPLES]]
    least, inlier_distance = max(MIN_GAUSSIANS, MIN_SHARE * len(points)), INLIER_DISTANCE * radius
    for normal, offset in islice(search_planes(points, inlier_distance, generator, least), PLANES):
        on_plane = np.abs(means @ normal - offset) < inlier_distance
        if on_plane[is_object].mean() < MAX_OBJECT_SHARE:
            found |= on_plane & near
    return found
