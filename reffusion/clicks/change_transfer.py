"""Transfer of a change of the mask from one view to all others, by the surface and by the segmentation network."""

from __future__ import annotations

import numpy as np

from reffusion.clicks.events import Masks
from reffusion.clicks.fitted_views import FittedViews, sample_visible
from reffusion.clicks.marks import Clicks
from reffusion.clicks.mask_borders import bounding_box
from reffusion.clicks.propagation import MIN_PIXELS, deepest_points, iou, order_by_distance
from reffusion.clicks.segmenter import Prompt
from reffusion.clicks.single_view import ViewEvidence

SOURCES = 3  # a change is transferred to a view from this many nearest views
# A region's bounding sphere has this many times the radius that holds this share of the region's pixels. The depth of
# the other pixels may be wrong.
SPHERE_FACTOR, SPHERE_QUANTILE = 1.2, 0.95
# Least IoU between the network's mask after a correction and the mask that is expected by depth alone, in the whole
# view and outside the sphere.
LEAST_IOU, LEAST_IOU_OUTSIDE = 0.75, 0.8


def transfer_change(
    views: FittedViews, name: str, region: np.ndarray, masks: Masks, fixed: Masks, positive: bool
) -> dict[str, np.ndarray]:
    """Return the pixels of all other views that change with a region of one view, view -> bool [H, W].

    The change goes from view to view, by distance. In each view the pixels change whose surface is changed in most of
    the nearest views so far that show it. The segmentation network finds further pixels, such as those of other sides
    of the same part of the object. They lie within the region's bounding sphere in 3D. The network is not used where
    its best mask differs much from the mask that is expected by depth alone.

    Args:
        name: the view of the region.
        region: bool [H, W], the changed pixels; not empty.
        masks: view -> bool [H, W], the masks of all views before the change.
        fixed: the views whose masks do not change.
        positive: True if the region is added to the object, False if it is removed.
    """
    center, radius = _bounding_sphere(views, name, region)
    cameras = {key: camera for key, camera in views.cameras.items() if key == name or key not in fixed}
    changes = {name: region}
    # Votes for a change, 1, and against it, -1. A stroke covers a part of what is wrong in its own view, so this view
    # does not vote against a change.
    ballots = {name: region.astype(np.int8)}
    for other in order_by_distance(cameras, changes):
        distance = lambda key, at=cameras[other].center: float(np.linalg.norm(cameras[key].center - at))
        sources = sorted(ballots, key=distance)[:SOURCES]
        surface = views.surface(other)
        near = np.linalg.norm(surface - center, axis=-1) < radius
        shown, points = np.zeros_like(near), surface[near]
        if len(points):
            shown[near] = sum(sample_visible(views, source, ballots[source], points) for source in sources) > 0
        change = shown
        if other in views.network_views:
            change = shown | _ask_near(views.evidence_of(other), masks[other], shown, near, positive)
        if change.any():
            changes[other] = change
            ballots[other] = change.astype(np.int8) - (~change & (masks[other] != positive))
    return {other: change for other, change in changes.items() if other != name}


def _ask_near(view: ViewEvidence, mask: np.ndarray, shown: np.ndarray, near: np.ndarray, positive: bool) -> np.ndarray:
    """Return bool [H, W], the pixels of `near` at which the segmentation network adds to a mask, or removes from it.

    Args:
        mask: bool [H, W], the mask of the view before the change.
        shown: bool [H, W], the pixels that change by depth alone.
        near: bool [H, W], the pixels that may change.
        positive: True to add pixels, False to remove them.
    """
    expected = mask | shown if positive else mask & ~shown
    if view.ask is None or not near.any() or expected.sum() < MIN_PIXELS:
        return np.zeros_like(mask)
    points, signs = [deepest_points(expected).points], [True]
    if shown.any():
        points, signs = [*points, deepest_points(shown).points], [*signs, positive]
    clicks = Clicks(np.concatenate(points), np.repeat(signs, [len(each) for each in points]))
    boxes = [None, bounding_box(expected), bounding_box(expected | near)]
    candidates = [each.mask for box in boxes for each in view.ask(Prompt(clicks, box))]
    best = max(candidates, key=lambda candidate: iou(candidate, expected))
    if iou(best, expected) < LEAST_IOU or iou(best & ~near, expected & ~near) < LEAST_IOU_OUTSIDE:
        return np.zeros_like(mask)
    return near & (best & ~mask if positive else mask & ~best)


def _bounding_sphere(views: FittedViews, name: str, region: np.ndarray) -> tuple[np.ndarray, float]:
    """Return centre [3] and radius of a sphere around the surface that a view shows inside a region, bool [H, W]."""
    points = views.surface(name)[region]
    center = np.median(points, 0)
    return center, SPHERE_FACTOR * float(np.quantile(np.linalg.norm(points - center, axis=1), SPHERE_QUANTILE))
