"""Masks of all views from marks (clicks and brush strokes) in some views.

The view of the first mark is segmented, and its mask is propagated to all views. Each later mark is a correction. A
correction adds a region to the mask of its own view, or removes one. In each other view it changes the pixels that show
the surface of this region, and pixels near it by the segmentation network, without pixels that earlier marks confirm to
be the opposite. A click on another object adds that object to all views.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from reffusion import geometry
from reffusion.clicks import all_views
from reffusion.clicks.color_evidence import spread_evenly
from reffusion.clicks.corrections import apply_marks
from reffusion.clicks.marks import OBJECT, OTHER, Clicks, Mark, confirmed_pixels
from reffusion.clicks.mask_borders import bounding_box
from reffusion.clicks.propagation import MIN_PIXELS, deepest_points, iou, order_by_distance, propagate_masks
from reffusion.clicks.segmenter import Prompt
from reffusion.clicks.single_view import ViewEvidence
from reffusion.gaussians.neighbours import find_neighbours
from reffusion.morphology import dilate
from reffusion.types import Camera, Gaussians

Masks = Mapping[str, np.ndarray]  # view -> bool [H, W]
Recall = Callable[[Hashable, Callable[[], Masks]], Masks]  # (key, compute) -> masks, see `segment_scene`
MAX_ASKED = 64  # most views in which the network is asked; in other views the votes of these decide
SAME_SURFACE = 0.02  # relative difference of depth below which two views show the same surface point
SOURCES = 3  # a change is transferred to a view from this many nearest views
# A region's bounding sphere has this many times the radius that holds this share of the region's pixels. The depth of
# the other pixels may be wrong.
SPHERE_FACTOR, SPHERE_QUANTILE = 1.2, 0.95
# Least IoU between the network's mask after a correction and the mask that is expected by depth alone, in the whole
# view and outside the sphere.
LEAST_IOU, LEAST_IOU_OUTSIDE = 0.75, 0.8


@dataclass(frozen=True)
class Event:
    """A mark (click or brush stroke) that a person makes in a view.

    Attributes:
        view: name of the view.
    """

    view: str
    mark: Mark

    @property
    def key(self) -> tuple[str, bool, float, bytes]:
        """A hashable key, which is equal for equal events."""
        return self.view, self.mark.positive, self.mark.radius, self.mark.points.tobytes()


@dataclass(frozen=True)
class FittedViews:
    """A fitted scene and its views.

    Attributes:
        gaussians: the fit, including the object.
        cameras: view -> Camera, for the views whose photographs show the object.
        evidence_of: function from a view's name to its photograph, relief and segmentation network.
    """

    gaussians: Gaussians
    cameras: Mapping[str, Camera]
    evidence_of: Callable[[str], ViewEvidence]

    @cached_property
    def asked(self) -> frozenset[str]:
        """The views in which the network is asked for the object that other views show, evenly spread by name."""
        return frozenset(spread_evenly(sorted(self.cameras), MAX_ASKED))


def compute_always(_: Hashable, compute: Callable[[], Masks]) -> Masks:
    """Compute the masks without a cache: the default `recall` of `segment_scene`."""
    return compute()


def segment_scene(
    views: FittedViews, events: Sequence[Event], given: Masks, recall: Recall = compute_always
) -> dict[str, np.ndarray]:
    """Return the object's mask in every view, view -> bool [H, W].

    Without given masks, the first clicks select the object in their own view (see `count_first`), this mask is
    propagated, and later events are corrections. All masks are False if no mark is on the object. With given masks,
    these are propagated, and all events are corrections.

    Args:
        events: the marks, in the order in which they were made.
        given: view -> bool [H, W], masks that the scene provides. Only an event in the same view changes such a mask.
        recall: cache of the results after each event, so that a further event does not repeat the work for the earlier
            events. It maps (key, compute) to the stored masks for this key, or else to the result of compute(). The key
            holds the events only, so different scenes or given masks must not share a cache.
    """
    count = 0 if given else count_first(events)
    masks = given
    if count:
        masks = segment_own_view(views.evidence_of, events[:count], recall)
    for k in range(count, len(events) + 1):
        correct = partial(correct_scene, views, events[:k], masks, given, recall)
        step = correct if k > count else partial(propagate, views, masks)
        masks = recall(("all views", *(event.key for event in events[:k])), step)
    return dict(masks)


def segment_own_view(
    evidence_of: Callable[[str], ViewEvidence], events: Sequence[Event], recall: Recall = compute_always
) -> Masks:
    """Return the mask of one view from its own marks alone, as {view name: bool [H, W]}.

    Args:
        evidence_of: function from the view's name to its photograph, relief and segmentation network.
        events: the marks in this view, at least one, in the order in which they were made.
        recall: cache of results, as for `segment_scene`.
    """
    name, marks = events[0].view, [event.mark for event in events]
    masks: Masks = {}
    for k in range(1, len(events) + 1):
        step = partial(_apply_last_mark, evidence_of, name, marks[:k], masks.get(name))
        masks = recall(("own view", *(event.key for event in events[:k])), step)
    return masks


def _apply_last_mark(
    evidence_of: Callable[[str], ViewEvidence], name: str, marks: Sequence[Mark], before: np.ndarray | None
) -> Masks:
    return {name: apply_marks(evidence_of(name), marks, before, first=len(marks) - 1)}


def count_first(events: Sequence[Event]) -> int:
    """Return how many events, from the first on, make the mask of the first event's view before it is propagated.

    These are the first event (a click or a stroke) and the clicks in the same view that directly follow it. The first
    later stroke, or event in another view, ends the count and is not included.
    """
    apart = lambda event: event.view != events[0].view or event.mark.radius > 0
    return next((k for k, event in enumerate(events) if k and apart(event)), len(events))


def propagate(views: FittedViews, masks: Masks) -> dict[str, np.ndarray]:
    """Propagate masks to all views: view -> bool [H, W], by the segmentation network if there is one.

    Args:
        masks: view -> bool [H, W], the known masks, which are returned unchanged. If all are empty or there are none,
            the masks of all other views are all False.
    """
    if not any(mask.any() for mask in masks.values()):
        empty = lambda camera: np.zeros((camera.height, camera.width), bool)
        return {name: empty(camera) for name, camera in views.cameras.items()} | dict(masks)
    if views.evidence_of(next(iter(masks))).ask is not None:
        return propagate_masks(views.gaussians, views.cameras, views.evidence_of, masks, views.asked)
    image_of = lambda name: views.evidence_of(name).image
    near = find_neighbours(views.gaussians)
    labels = all_views.label_gaussians(views.gaussians, near, views.cameras, masks, image_of)
    return dict(masks) | {
        name: all_views.object_mask(views.gaussians, labels, camera, image_of(name))
        for name, camera in views.cameras.items()
        if name not in masks
    }


def correct_scene(
    views: FittedViews, events: Sequence[Event], masks: Masks, given: Masks, recall: Recall = compute_always
) -> dict[str, np.ndarray]:
    """Return the masks of all views after the last event, view -> bool [H, W].

    Args:
        events: all marks so far; the last one is applied.
        masks: view -> bool [H, W], the masks of all views before the last event.
        given: view -> bool [H, W], masks that the scene provides; they do not change by events in other views.
        recall: cache of results, as for `segment_scene`.
    """
    name = events[-1].view
    own = correct_own_view(views, events, masks, recall)
    return spread_change(views, events, dict(masks) | own, masks[name], given)


def correct_own_view(
    views: FittedViews, events: Sequence[Event], masks: Masks, recall: Recall = compute_always
) -> Masks:
    """Return the mask of the last event's view after this event, as {view: bool [H, W]}.

    Args:
        events: all marks so far; the last one is applied.
        masks: view -> bool [H, W], the masks of all views before the last event.
        recall: cache of results, as for `segment_scene`.
    """
    name = events[-1].view
    step = lambda: {name: correct_view(views, events, masks[name])}
    return recall(("corrected view", *(event.key for event in events)), step)


def correct_view(views: FittedViews, events: Sequence[Event], before: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the mask of the last event's view after this event.

    Args:
        events: all marks so far; the last one is applied.
        before: bool [H, W], the mask of the same view before the last event.
    """
    name = events[-1].view
    marks = [event.mark for event in events if event.view == name]
    marks = [*transfer_marks(views, events, name), *marks]
    return apply_marks(views.evidence_of(name), marks, before, first=len(marks) - 1)


def transfer_marks(views: FittedViews, events: Sequence[Event], name: str) -> list[Mark]:
    """Return the marks of other views as clicks in one view, where this view shows the marked surface points.

    Each point of a stroke's path becomes a click. A correction of this view leaves pixels unchanged that these clicks
    confirm.

    Args:
        events: all marks so far; those in the view `name` itself are not used.
        name: the view to which marks are transferred.
    """
    camera, found = views.cameras[name], []
    depth = _depth(views.evidence_of(name), camera)
    for event in events:
        if event.view == name or event.view not in views.cameras:
            continue
        other = views.cameras[event.view]
        surface = geometry.unproject(_depth(views.evidence_of(event.view), other), other)
        points, inside = geometry.sample_nearest(surface, event.mark.points)
        uv, z = geometry.project(points[inside], camera)
        here, inside = geometry.sample_nearest(depth, uv)
        visible = inside & (z > 0) & (np.abs(here - z) < SAME_SURFACE * z)
        found += [Mark(at[None], event.mark.positive) for at in uv[visible]]
    return found


def sample_visible(views: FittedViews, name: str, picture: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the values [P] of a view's picture at points; 0 where the view does not show the point.

    Args:
        picture: int8 [H, W], of the view `name`.
        points: [P, 3].
    """
    uv, z = geometry.project(points, views.cameras[name])
    values, inside = geometry.sample_nearest(picture, uv)
    here, _ = geometry.sample_nearest(_depth(views.evidence_of(name), views.cameras[name]), uv)
    return np.where(inside & (np.abs(here - z) < SAME_SURFACE * z), values, 0)


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
        surface = geometry.unproject(_depth(views.evidence_of(other), cameras[other]), cameras[other])
        near = np.linalg.norm(surface - center, axis=-1) < radius
        shown, points = np.zeros_like(near), surface[near]
        if len(points):
            shown[near] = sum(sample_visible(views, source, ballots[source], points) for source in sources) > 0
        change = shown
        if other in views.asked:
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
    points = geometry.unproject(_depth(views.evidence_of(name), views.cameras[name]), views.cameras[name])[region]
    center = np.median(points, 0)
    return center, SPHERE_FACTOR * float(np.quantile(np.linalg.norm(points - center, axis=1), SPHERE_QUANTILE))


def _depth(view: ViewEvidence, camera: Camera) -> np.ndarray:
    assert view.relief is not None
    return np.exp(view.relief / camera.fx)


def spread_change(
    views: FittedViews,
    events: Sequence[Event],
    masks: Masks,
    before: np.ndarray,
    given: Masks,
) -> dict[str, np.ndarray]:
    """Return the masks of all views, view -> bool [H, W], after the last event's change is made in all other views.

    If a click on the object added a region that does not touch the mask before, the region is another object. Its mask
    is propagated to all views. Otherwise the change is transferred (see `transfer_change`). Pixels that marks of a view
    confirm to be the opposite do not change.

    Args:
        events: all marks so far; the last one made the change.
        masks: view -> bool [H, W], all views; the mask of the last event's view is changed already.
        before: bool [H, W], the mask of the last event's view before the event.
        given: view -> bool [H, W], masks that the scene provides; they do not change by events in other views.
    """
    name, mark = events[-1].view, events[-1].mark
    change = masks[name] != before
    if not change.any():
        return dict(masks)
    apart = mark.positive and not mark.radius and not dilate(before, 1 / before.shape[1])[change].any()
    if apart:  # other views may show parts of the new object that this view hides, so depth alone is not enough
        regions = propagate_masks(views.gaussians, views.cameras, views.evidence_of, {name: change}, views.asked)
    else:
        regions = transfer_change(views, name, change, masks, given, mark.positive)
    found = dict(masks)
    for other, region in regions.items():
        if other == name or other in given or not region.any():
            continue
        marks = [event.mark for event in events if event.view == other]
        region = region & (confirmed_pixels(marks, region.shape) != (OTHER if mark.positive else OBJECT))
        found[other] = masks[other] | region if mark.positive else masks[other] & ~region
    return found
