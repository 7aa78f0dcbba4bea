"""Masks of all views from marks (clicks and brush strokes) in some views.

The first marks segment the object in their own views, and these masks are propagated to all views. Later marks are
corrections. A correction adds a region to the mask of its own view, or removes one. Then the masks of all views with
marks are propagated anew; they stay as their marks made them. A click on another object adds that object to all views.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from reffusion.clicks import propagation_without_network
from reffusion.clicks.corrections import apply_marks
from reffusion.clicks.events import Event, Masks, group_by_view, split_events
from reffusion.clicks.fitted_views import FittedViews, transfer_marks
from reffusion.clicks.marks import OTHER, confirmed_pixels
from reffusion.clicks.propagation_with_network import propagate_masks
from reffusion.clicks.single_view import ViewEvidence
from reffusion.gaussians.neighbors import find_neighbors
from reffusion.morphology import dilate

Recall = Callable[[Hashable, Callable[[], Masks]], Masks]  # (key, compute) -> masks, see `segment_scene`


@dataclass(frozen=True)
class SavedMasks:
    """Masks that were saved after some marks.

    Attributes:
        events: the marks, in the order in which they were made.
        masks: view -> bool [H, W], the masks of all views after these marks.
    """

    events: Sequence[Event]
    masks: Masks


def no_cache(_: Hashable, compute: Callable[[], Masks]) -> Masks:
    """Compute the masks without a cache: the default `recall` of `segment_scene`."""
    return compute()


def segment_scene(
    views: FittedViews,
    events: Sequence[Event],
    given: Masks,
    recall: Recall = no_cache,
    settled: SavedMasks | None = None,
) -> dict[str, np.ndarray]:
    """Return the object's mask in every view, view -> bool [H, W].

    The first events select the object in their own views (see `split_events`). These masks and the given ones are
    propagated, and stay as they are. Later events are corrections; those that follow each other in one view are made
    together. All masks are False if no mark is on the object and none is given.

    Args:
        events: the marks, in the order in which they were made.
        given: view -> bool [H, W], masks that the scene provides. Only an event in the same view changes such a mask.
        recall: cache of the results after each group of events, so that further events do not repeat the work for the
            earlier ones. The function maps (key, compute) to the stored masks for this key, else to the result of
            compute(). The key holds the events only, so different scenes or given masks must not share a cache.
        settled: the masks after the first of the events, which are then not computed anew; None for none.
    """
    if settled is not None:
        done, masks = list(settled.events), settled.masks
        known = {name: masks[name] for name in {*given, *(event.view for event in done)}}
        groups = group_by_view(events[len(done) :])
    else:
        first, groups = split_events(events, given)
        known = dict(given) | segment_first(views.evidence_of, first, recall)
        done = [event for own in first.values() for event in own]
        masks = recall(("all views", *(event.key for event in done)), partial(propagate, views, known))
    for group in groups:
        done = [*done, *group]
        step = partial(correct_scene, views, done, len(group), masks, frozenset(known), given, recall)
        masks = recall(("all views", *(event.key for event in done)), step)
        known = {name: masks[name] for name in {*known, group[0].view}}
    return dict(masks)


def segment_first(
    evidence_of: Callable[[str], ViewEvidence], first: Mapping[str, Sequence[Event]], recall: Recall = no_cache
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
    evidence_of: Callable[[str], ViewEvidence], events: Sequence[Event], recall: Recall = no_cache
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


def propagate(views: FittedViews, masks: Masks, former: Masks | None = None) -> dict[str, np.ndarray]:
    """Propagate masks to all views: view -> bool [H, W], by the segmentation network if there is one.

    Args:
        masks: view -> bool [H, W], the known masks, which are returned unchanged. If all are empty or there are none,
            the masks of all other views are all False.
        former: view -> bool [H, W], the masks of all views before a correction; see `propagate_masks`.
    """
    if not any(mask.any() for mask in masks.values()):
        empty = lambda camera: np.zeros((camera.height, camera.width), bool)
        return {name: empty(camera) for name, camera in views.cameras.items()} | dict(masks)
    if views.evidence_of(next(iter(masks))).ask is not None:
        return propagate_masks(views.gaussians, views.cameras, views.evidence_of, masks, views.network_views, former)
    image_of = lambda name: views.evidence_of(name).image
    near = find_neighbors(views.gaussians)
    labels = propagation_without_network.label_gaussians(views.gaussians, near, views.cameras, masks, image_of)
    return dict(masks) | {
        name: propagation_without_network.object_mask(views.gaussians, labels, camera, image_of(name))
        for name, camera in views.cameras.items()
        if name not in masks
    }


def correct_scene(
    views: FittedViews,
    events: Sequence[Event],
    count: int,
    masks: Masks,
    known: Collection[str],
    given: Masks,
    recall: Recall = no_cache,
) -> dict[str, np.ndarray]:
    """Return the masks of all views after the last `count` events, which are in one view, view -> bool [H, W].

    This view becomes a known one, and all known masks are propagated to the remaining views. If clicks on the object
    added a region that does not touch the mask before, the region is another object: its mask is propagated alone, and
    added to all views, except where marks of a view are against it.

    Args:
        events: all marks so far.
        count: number of events to apply.
        masks: view -> bool [H, W], the masks of all views before these events.
        known: the views whose masks were propagated to the others: given ones, and those in which marks were made.
        given: view -> bool [H, W], masks that the scene provides; they do not change by events in other views.
        recall: cache of results, as for `segment_scene`.
    """
    name = events[-1].view
    own = correct_own_view(views, events, count, masks, recall)
    added = own[name] & ~masks[name]
    by_clicks = not any(event.mark.radius for event in events[-count:])
    touches = bool(dilate(masks[name], 1 / masks[name].shape[1])[added].any())
    if by_clicks and added.any() and not touches:
        # Views that became known before do not have the new object, and would vote against it.
        regions = propagate(views, {name: added})
        found = {other: mask | (regions[other] & _is_allowed(events, other, mask)) for other, mask in masks.items()}
        return found | dict(given) | own
    return propagate(views, {other: masks[other] for other in known} | own, masks)


def _is_allowed(events: Sequence[Event], name: str, mask: np.ndarray) -> np.ndarray:
    """Return bool [H, W], False where marks of the view `name` confirm that a pixel is not the object."""
    return confirmed_pixels([event.mark for event in events if event.view == name], mask.shape) != OTHER


def correct_own_view(
    views: FittedViews, events: Sequence[Event], count: int, masks: Masks, recall: Recall = no_cache
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
        step = lambda past=events[:k], before=found[name]: {name: correct_view(views, past, before)}
        found = recall(("corrected view", *(event.key for event in events[:k])), step)
    return dict(found)


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
