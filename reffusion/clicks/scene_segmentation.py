"""Masks of all views from marks in some: the first marked view is segmented and propagated, later marks correct.

A correction adds a region to the mask of its view or removes one, and does the same where other views show the surface
of that region, except where marks confirm the contrary. So nothing changes away from it. A click on another object adds
that object to all views.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from reffusion import geometry
from reffusion.clicks import all_views
from reffusion.clicks.marks import OBJECT, OTHER, Mark, confirmed_pixels
from reffusion.clicks.propagation import propagate_masks
from reffusion.clicks.single_view import ViewEvidence, apply_marks
from reffusion.gaussians.neighbours import find_neighbours
from reffusion.morphology import dilate
from reffusion.types import Camera, Gaussians

Masks = Mapping[str, np.ndarray]  # view -> bool [H, W]
Recall = Callable[[Hashable, Callable[[], Masks]], Masks]
SAME_SURFACE = 0.02  # of the depth: a marked point is visible in another view up to this difference


@dataclass(frozen=True)
class Event:
    """A mark that a person makes in a view."""

    view: str
    mark: Mark

    @property
    def key(self) -> tuple[str, bool, float, bytes]:
        """Equal for equal events."""
        return self.view, self.mark.positive, self.mark.radius, self.mark.points.tobytes()


@dataclass(frozen=True)
class FittedViews:
    """A fitted scene, and what is known of its views.

    Attributes:
        cameras: of the views whose photographs show the object.
        evidence_of: view -> its photograph, relief and segmentation network.
    """

    gaussians: Gaussians
    cameras: Mapping[str, Camera]
    evidence_of: Callable[[str], ViewEvidence]


def compute_always(_: Hashable, compute: Callable[[], Masks]) -> Masks:
    """Remember nothing: the default `recall` of `segment_scene`."""
    return compute()


def segment_scene(
    views: FittedViews, events: Sequence[Event], given: Masks, recall: Recall = compute_always
) -> dict[str, np.ndarray]:
    """The object's mask, bool [H, W], in every view; empty if nothing marks the object.

    Args:
        events: in the order in which they are made.
        given: view -> bool [H, W]; they stay as they are.
        recall: (key, compute) -> an earlier result with this key, or that of compute().
    """
    count = 0 if given else count_first(events)
    masks = given
    if count:
        masks = segment_own_view(views.evidence_of, events[:count], recall)
    for k in range(count, len(events) + 1):
        step = (
            partial(correct_scene, views, events[:k], masks, given) if k > count else partial(propagate, views, masks)
        )
        masks = recall(("all views", *(event.key for event in events[:k])), step)
    return dict(masks)


def segment_own_view(
    evidence_of: Callable[[str], ViewEvidence], events: Sequence[Event], recall: Recall = compute_always
) -> Masks:
    """The mask of a view from its own marks alone, under its name; `events`: at least one, all of this view."""
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
    """The number of events that select the object: those in the view of the first one, until a stroke follows."""
    apart = lambda event: event.view != events[0].view or event.mark.radius > 0
    return next((k for k, event in enumerate(events) if k and apart(event)), len(events))


def propagate(views: FittedViews, masks: Masks) -> dict[str, np.ndarray]:
    """The object's mask, bool [H, W], in every view; the masks that are given stay."""
    if not any(mask.any() for mask in masks.values()):
        empty = lambda camera: np.zeros((camera.height, camera.width), bool)
        return {name: empty(camera) for name, camera in views.cameras.items()} | dict(masks)
    if views.evidence_of(next(iter(masks))).ask is not None:
        return propagate_masks(views.gaussians, views.cameras, views.evidence_of, masks)
    image_of = lambda name: views.evidence_of(name).image
    near = find_neighbours(views.gaussians)
    labels = all_views.label_gaussians(views.gaussians, near, views.cameras, masks, image_of)
    return dict(masks) | {
        name: all_views.object_mask(views.gaussians, labels, camera, image_of(name))
        for name, camera in views.cameras.items()
        if name not in masks
    }


def correct_scene(views: FittedViews, events: Sequence[Event], masks: Masks, given: Masks) -> dict[str, np.ndarray]:
    """The masks of all views after the last event, from those before it."""
    name = events[-1].view
    after = correct_view(views, events, masks[name])
    return spread_change(views, events, dict(masks) | {name: after}, masks[name], given)


def correct_view(views: FittedViews, events: Sequence[Event], before: np.ndarray) -> np.ndarray:
    """bool [H, W]: the mask of the last event's view after that event, from the mask before it."""
    name = events[-1].view
    marks = [event.mark for event in events if event.view == name]
    marks = [*transfer_marks(views, events, name), *marks]
    return apply_marks(views.evidence_of(name), marks, before, first=len(marks) - 1)


def transfer_marks(views: FittedViews, events: Sequence[Event], name: str) -> list[Mark]:
    """Clicks where a view shows points that are marked in other views: a correction keeps what they confirm."""
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


def transfer_region(views: FittedViews, name: str, region: np.ndarray, other: str) -> np.ndarray:
    """bool [H, W]: where another view shows the surface that a view shows inside a region, bool [H, W]."""
    camera, there = views.cameras[name], views.cameras[other]
    uv, z = geometry.project(geometry.unproject(_depth(views.evidence_of(other), there), there), camera)
    hit, inside = geometry.sample_nearest(region, uv)
    here, _ = geometry.sample_nearest(_depth(views.evidence_of(name), camera), uv)
    return hit & inside & (np.abs(here - z) < SAME_SURFACE * z)


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
    """The masks of all views after the last event changed the mask of its own view.

    Args:
        masks: of all views; that of the event's view is changed already.
        before: bool [H, W], the mask of the event's view before it.
    """
    name, mark = events[-1].view, events[-1].mark
    change = masks[name] != before
    if not change.any():
        return dict(masks)
    apart = mark.positive and not mark.radius and not dilate(before, 1 / before.shape[1])[change].any()
    if apart:  # another object, of which other views show more than this one
        regions = propagate_masks(views.gaussians, views.cameras, views.evidence_of, {name: change})
    else:
        regions = {other: transfer_region(views, name, change, other) for other in views.cameras}
    found = dict(masks)
    for other, region in regions.items():
        if other == name or other in given or not region.any():
            continue
        marks = [event.mark for event in events if event.view == other]
        region = region & (confirmed_pixels(marks, region.shape) != (OTHER if mark.positive else OBJECT))
        found[other] = masks[other] | region if mark.positive else masks[other] & ~region
    return found
