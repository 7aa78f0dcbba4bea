"""Masks of all views from marks (clicks and brush strokes) in some views.

The first marks segment the object in their own views, and these masks are propagated to all views. Later marks are
corrections. A correction adds a region to the mask of its own view, or removes one. In each other view it changes the
pixels that show the surface of this region, and pixels near it by the segmentation network, without pixels that earlier
marks confirm to be the opposite. A click on another object adds that object to all views.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import groupby

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
MAX_NETWORK_VIEWS = 64  # most views in which the network is asked; in other views the votes of these decide
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
        is_early: True if it was made before there were masks of all views. The person then saw the mask of this view
            alone, as its own marks make it.
    """

    view: str
    mark: Mark
    is_early: bool = False

    @property
    def key(self) -> tuple[str, bool, float, bytes, bool]:
        """A hashable key, which is equal for equal events."""
        return self.view, self.mark.positive, self.mark.radius, self.mark.points.tobytes(), self.is_early


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
    def network_views(self) -> frozenset[str]:
        """The views in which the network is asked for the object that other views show, evenly spread by name."""
        return frozenset(spread_evenly(sorted(self.cameras), MAX_NETWORK_VIEWS))


def compute_always(_: Hashable, compute: Callable[[], Masks]) -> Masks:
    """Compute the masks without a cache: the default `recall` of `segment_scene`."""
    return compute()


def segment_scene(
    views: FittedViews, events: Sequence[Event], given: Masks, recall: Recall = compute_always
) -> dict[str, np.ndarray]:
    """Return the object's mask in every view, view -> bool [H, W].

    The first events select the object in their own views (see `split_events`). These masks and the given ones are
    propagated, and stay as they are. Later events are corrections; those that follow each other in one view are made
    together. All masks are False if no mark is on the object and none is given.

    Args:
        events: the marks, in the order in which they were made.
        given: view -> bool [H, W], masks that the scene provides. Only an event in the same view changes such a mask.
        recall: cache of the results after each group of events, so that further events do not repeat the work for the
            earlier ones. It maps (key, compute) to the stored masks for this key, or else to the result of compute().
            The key holds the events only, so different scenes or given masks must not share a cache.
    """
    first, groups = split_events(events, given)
    masks = dict(given) | segment_first(views.evidence_of, first, recall)
    done = [event for own in first.values() for event in own]
    masks = recall(("all views", *(event.key for event in done)), partial(propagate, views, masks))
    for group in groups:
        done = [*done, *group]
        step = partial(correct_scene, views, done, len(group), masks, given, recall)
        masks = recall(("all views", *(event.key for event in done)), step)
    return dict(masks)


def split_events(events: Sequence[Event], given: Masks) -> tuple[dict[str, list[Event]], list[list[Event]]]:
    """Return the events that select the object, view -> events, and the corrections in groups of one view each.

    The object is selected by the early events in views that have no given mask and a positive early event. If there are
    neither such events nor given masks, it is selected by the first event and the clicks in the same view that directly
    follow it.

    Args:
        events: the marks, in the order in which they were made.
        given: view -> bool [H, W], masks that the scene provides.
    """
    early_views = {event.view for event in events if event.is_early and event.mark.positive} - {*given}
    selection = [event.is_early and event.view in early_views for event in events]
    if not given and not early_views:
        apart = lambda event: event.view != events[0].view or event.mark.radius > 0
        count = next((k for k, event in enumerate(events) if k and apart(event)), len(events))
        selection = [k < count for k in range(len(events))]
    first: dict[str, list[Event]] = {}
    rest = []
    for event, is_first in zip(events, selection, strict=True):
        (first.setdefault(event.view, []) if is_first else rest).append(event)
    return first, [list(group) for _, group in groupby(rest, key=lambda event: event.view)]


def segment_first(
    evidence_of: Callable[[str], ViewEvidence], first: Mapping[str, Sequence[Event]], recall: Recall = compute_always
) -> dict[str, np.ndarray]:
    """Return the masks of the views in which the object is selected, view -> bool [H, W].

    Args:
        evidence_of: function from a view's name to its photograph, relief and segmentation network.
        first: view -> its events, from `split_events`.
        recall: cache of results, as for `segment_scene`.
    """
    found: dict[str, np.ndarray] = {}
    for events in first.values():
        found |= segment_own_view(evidence_of, events, recall)
    return found


def segment_own_view(
    evidence_of: Callable[[str], ViewEvidence], events: Sequence[Event], recall: Recall = compute_always
) -> Masks:
    """Return the mask of one view from its own marks alone, as {view name: bool [H, W]}.

    Early events give the mask that the person saw, which a fit does not change: without the view's relief.

    Args:
        evidence_of: function from the view's name to its photograph, relief and segmentation network.
        events: the marks in this view, at least one, in the order in which they were made.
        recall: cache of results, as for `segment_scene`.
    """
    name = events[0].view
    masks: Masks = {}
    for k in range(1, len(events) + 1):
        step = partial(_apply_last_event, evidence_of, events[:k], masks.get(name))
        masks = recall(("own view", *(event.key for event in events[:k])), step)
    return masks


def _apply_last_event(
    evidence_of: Callable[[str], ViewEvidence], events: Sequence[Event], before: np.ndarray | None
) -> Masks:
    last = events[-1]
    view = evidence_of(last.view)
    if last.is_early:
        view = replace(view, relief=None)
    return {last.view: apply_marks(view, [event.mark for event in events], before, first=len(events) - 1)}


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
        return _propagate_by_network(views, masks)
    image_of = lambda name: views.evidence_of(name).image
    near = find_neighbours(views.gaussians)
    labels = all_views.label_gaussians(views.gaussians, near, views.cameras, masks, image_of)
    return dict(masks) | {
        name: all_views.object_mask(views.gaussians, labels, camera, image_of(name))
        for name, camera in views.cameras.items()
        if name not in masks
    }


def _propagate_by_network(views: FittedViews, masks: Masks) -> dict[str, np.ndarray]:
    return propagate_masks(views.gaussians, views.cameras, views.evidence_of, masks, views.network_views)


def correct_scene(
    views: FittedViews, events: Sequence[Event], count: int, masks: Masks, given: Masks, recall: Recall = compute_always
) -> dict[str, np.ndarray]:
    """Return the masks of all views after the last `count` events, which are in one view, view -> bool [H, W].

    Args:
        events: all marks so far.
        count: number of events to apply.
        masks: view -> bool [H, W], the masks of all views before these events.
        given: view -> bool [H, W], masks that the scene provides; they do not change by events in other views.
        recall: cache of results, as for `segment_scene`.
    """
    name = events[-1].view
    own = correct_own_view(views, events, count, masks, recall)
    before, after, found = masks[name], own[name], dict(masks) | own
    for change, positive in ((after & ~before, True), (before & ~after, False)):
        found = spread_change(views, events, count, found, before, change, positive, given)
    return found


def correct_own_view(
    views: FittedViews, events: Sequence[Event], count: int, masks: Masks, recall: Recall = compute_always
) -> dict[str, np.ndarray]:
    """Return the mask of the last event's view after the last `count` events, as {view: bool [H, W]}.

    Args:
        events: all marks so far; the last `count` ones are in one view.
        count: number of events to apply.
        masks: view -> bool [H, W], the masks of all views before these events.
        recall: cache of results, as for `segment_scene`.
    """
    name = events[-1].view
    found: Masks = {name: masks[name]}
    for k in range(len(events) - count + 1, len(events) + 1):
        step = partial(_correct_view, views, events[:k], found[name])
        found = recall(("corrected view", *(event.key for event in events[:k])), step)
    return dict(found)


def _correct_view(views: FittedViews, events: Sequence[Event], before: np.ndarray) -> Masks:
    return {events[-1].view: correct_view(views, events, before)}


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
    points = geometry.unproject(_depth(views.evidence_of(name), views.cameras[name]), views.cameras[name])[region]
    center = np.median(points, 0)
    return center, SPHERE_FACTOR * float(np.quantile(np.linalg.norm(points - center, axis=1), SPHERE_QUANTILE))


def _depth(view: ViewEvidence, camera: Camera) -> np.ndarray:
    assert view.relief is not None
    return np.exp(view.relief / camera.fx)


def spread_change(
    views: FittedViews,
    events: Sequence[Event],
    count: int,
    masks: Masks,
    before: np.ndarray,
    change: np.ndarray,
    positive: bool,
    given: Masks,
) -> dict[str, np.ndarray]:
    """Return the masks of all views, view -> bool [H, W], after a change in one view is made in all others.

    If clicks on the object added a region that does not touch the mask before, the region is another object. Its mask
    is propagated to all views. Otherwise the change is transferred (see `transfer_change`). Pixels that marks of a view
    confirm to be the opposite do not change.

    Args:
        events: all marks so far.
        count: number of the last events, all in one view, which made the change.
        masks: view -> bool [H, W], all views; the mask of that view is changed already.
        before: bool [H, W], the mask of that view before these events.
        change: bool [H, W], the pixels of that view that were added (`positive`) or removed.
        positive: True if the pixels were added.
        given: view -> bool [H, W], masks that the scene provides; they do not change by events in other views.
    """
    name = events[-1].view
    if not change.any():
        return dict(masks)
    by_clicks = not any(event.mark.radius for event in events[-count:])
    if positive and by_clicks and not dilate(before, 1 / before.shape[1])[change].any():
        # Other views may show parts of the new object that this view hides, so depth alone is not enough.
        regions = _propagate_by_network(views, {name: change})
    else:
        regions = transfer_change(views, name, change, masks, given, positive)
    found = dict(masks)
    for other, region in regions.items():
        if other == name or other in given or not region.any():
            continue
        marks = [event.mark for event in events if event.view == other]
        region = region & (confirmed_pixels(marks, region.shape) != (OTHER if positive else OBJECT))
        found[other] = masks[other] | region if positive else masks[other] & ~region
    return found
