"""Marks (clicks, boxes and brush strokes) in the order in which a person makes them, and what they are for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from reffusion.clicks.marks import Mark

Masks = Mapping[str, np.ndarray]  # view -> bool [H, W]


@dataclass(frozen=True)
class Event:
    """A mark (click, box or brush stroke) that a person makes in a view.

    Attributes:
        view: name of the view.
        mark: the mark, in pixels of the view.
        is_early: True if the mark was made before there were masks of all views. The person then saw only the mask of
            this view, as the view's own marks make it.
        ignores: True if the mark is a stroke over pixels that its view ignores, and says nothing about the object.
    """

    view: str
    mark: Mark
    is_early: bool = False
    ignores: bool = False

    @property
    def key(self) -> tuple[str, bool, float, str, bytes, bool, bool]:
        """A hashable key, which is equal for equal events."""
        mark = self.mark
        return self.view, mark.positive, mark.radius, mark.size, mark.points.tobytes(), self.is_early, self.ignores


def split_events(events: Sequence[Event], given: Masks) -> tuple[dict[str, list[Event]], list[list[Event]]]:
    """Split events into those that select the object, view -> events, and corrections, in groups of one view each.

    The object is selected by the early events in views that have no given mask and a positive early event. If there are
    neither such events nor given masks, it is selected by the first event and the clicks and boxes in the same view
    that directly follow it.

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
    return first, group_by_view(rest)


def group_by_view(events: Sequence[Event]) -> list[list[Event]]:
    """Return the events in their order, grouped while the view stays the same; a view may have several groups."""
    return [list(group) for _, group in groupby(events, key=lambda event: event.view)]
