"""Application of clicks, boxes and strokes to the mask of one photograph.

The first click selects an object. Each later click adds or removes one connected region around the clicked pixel. A box
adds or removes the thing inside it.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from reffusion.clicks.geodesic_cut import correct_labels
from reffusion.clicks.marks import OBJECT, OTHER, Clicks, Mark, clicks_of, confirmed_pixels, mark_pixels, stroke_pixels
from reffusion.clicks.mask_borders import BAND, bounding_box, find_thing_in_box, refine_edges
from reffusion.clicks.pixel_grid import downscale, find_depth_edges, part_at, pixel_pairs, upscale, value_at
from reffusion.clicks.segmenter import Prompt
from reffusion.clicks.single_view import ViewEvidence, pick_by_size, propose_masks, segment_view, select_object

# Penalties on a correction's merit: for each unit by which the logarithm of the mask's size grows or shrinks, and for
# changing a dot around the click only, which is right if all proposed regions are too large.
GROWTH_PENALTY, SHRINKAGE_PENALTY, DOT_PENALTY = 0.25, 0.15, 0.3


def apply_marks(
    view: ViewEvidence, marks: Sequence[Mark], before: np.ndarray | None = None, first: int = 0
) -> np.ndarray:
    """Return bool [H, W], the mask after marks are applied one after the other.

    A stroke changes the pixels below the brush. A box changes only pixels inside it. While the mask is empty, a click
    on the object selects the object. Each later click adds or removes one connected region around the clicked pixel.
    Clicks and boxes change no pixel that earlier marks confirm to be the opposite.

    Args:
        marks: all marks of the view, in the order in which they were made.
        before: bool [H, W], the mask after the marks before `first`, which is not changed; None for an empty mask.
        first: index of the first mark that is not yet applied in `before`.
    """
    shape = view.image.shape[:2]
    mask = np.zeros(shape, bool) if before is None else before
    for k in range(first, len(marks)):
        mark, done = marks[k], marks[: k + 1]
        if mark.radius:
            painted = stroke_pixels(mark, shape)
            mask = mask | painted if mark.positive else mask & ~painted
        elif mark.is_box:
            mask = apply_box(view, mask, done)
        elif mask.any():
            mask = correct_mask(view, mask, done)
        elif mark.positive:
            mask = segment_view(view, clicks_of(done), mark.size) & (confirmed_pixels(done, shape) != OTHER)
    return mask


def apply_box(view: ViewEvidence, before: np.ndarray, marks: Sequence[Mark]) -> np.ndarray:
    """Return bool [H, W], the mask `before` with the thing inside the last mark, a box, added or removed.

    The network proposes things. If the box has no size, the thing is taken that the network is surest of, and whose own
    bounding box is most like the box. Without a network, colors separate the thing from what surrounds the box. If
    nothing is found, the thing is the whole box.

    Args:
        marks: all marks of the view so far. Pixels that they confirm to be the opposite do not change.
    """
    mark = marks[-1]
    inside = np.zeros_like(before)
    left, top, right, bottom = (round(side) for side in mark.box)
    inside[top : max(bottom, top + 1), left : max(right, left + 1)] = True
    allowed = inside & (confirmed_pixels(marks, before.shape) != (OTHER if mark.positive else OBJECT))
    if view.ask is None:
        found = [(find_thing_in_box(view.image, inside), 1.0), (inside, 0.0)]
    else:
        found = [(each.mask & inside, each.score) for each in view.ask(Prompt(clicks_of([]), mark.box))]
    found = [pair for pair in found if pair[0].any()] or [(inside, 0.0)]
    if mark.size:
        thing = pick_by_size([mask for mask, _ in found], mark.size)
    else:
        thing = max(found, key=lambda pair: pair[1] * _fill_of_box(pair[0], inside))[0]
    return before | (thing & allowed) if mark.positive else before & ~(thing & allowed)


def _fill_of_box(mask: np.ndarray, box: np.ndarray) -> float:
    """Return the share of a box, bool [H, W], that the bounding box of a mask inside it covers."""
    left, top, right, bottom = bounding_box(mask)
    return (right - left) * (bottom - top) / float(box.sum())


def correct_mask(view: ViewEvidence, before: np.ndarray, marks: Sequence[Mark]) -> np.ndarray:
    """Return bool [H, W], the mask `before` with one connected region added or removed around the last mark, a click.

    A positive click adds a region, a negative click removes one. Small changes are preferred, unless the click has a
    size. The mask is returned unchanged if it agrees with the click already.

    Args:
        before: bool [H, W], the mask to correct.
        marks: all marks of the view so far. Pixels that they confirm to be the opposite of the click do not change.
    """
    clicks, confirmed, size = clicks_of(marks), confirmed_pixels(marks, before.shape), marks[-1].size
    at, positive = clicks.points[-1], bool(clicks.positive[-1])
    if value_at(before, at) == positive:
        return before
    reach = _reach_of_click(view, before, clicks)
    masks = [reach, *propose_masks(view, clicks)]
    alone = Clicks(
        np.concatenate([clicks.points[clicks.positive != positive], at[None]]),
        np.append(np.zeros((clicks.positive != positive).sum(), bool), True),
    )
    masks += [mask if positive else ~mask for mask in propose_masks(view, alone)]
    kept = confirmed == (OTHER if positive else OBJECT)
    regions = [part_at((mask & ~before if positive else before & ~mask) & ~kept, at) for mask in masks]
    inside = at.clip(0.5, np.array(before.shape[::-1]) - 0.5)  # a click outside the picture is moved to its border
    dot = stroke_pixels(Mark(inside[None], positive, max(2.0, BAND * max(before.shape))), before.shape)
    dot_region = (dot & ~before if positive else dot & before) & ~kept
    apply = lambda region: before | region if positive else before & ~region
    opposite, speck = clicks.points[clicks.positive != positive], int(dot.sum())
    proposed = [apply(region) for region in regions if region.any()]
    results = [result for result in proposed if not _leaves_speck(before, result, opposite, speck)]
    if size and results:
        changes = [result ^ before for result in results]
        return before ^ pick_by_size(changes, size)
    penalties = [_change_penalty(before, result, speck) for result in results]
    results, penalties = [*results, apply(dot_region)], [*penalties, DOT_PENALTY]
    best = select_object(view, clicks, results, penalties)
    return results[0] if best is None else best


def _leaves_speck(before: np.ndarray, after: np.ndarray, points: np.ndarray, least: int) -> bool:
    """Return whether a correction cuts the connected region (mask or rest) at one of `points` to below `least` px."""

    def is_speck(mask: np.ndarray, at: np.ndarray) -> bool:
        return bool(part_at(mask == value_at(before, at), at).sum() < least)

    return any(is_speck(after, at) and not is_speck(before, at) for at in points)


def _change_penalty(before: np.ndarray, after: np.ndarray, dot: int) -> float:
    """Return the penalty >= 0 on a correction's merit for growth, shrinkage, and a change below `dot` pixels."""
    growth = float(np.log(max(after.sum(), 1) / max(before.sum(), 1)))
    # a person hardly clicks to change less than a dot around the click
    tiny = max(0.0, 1 - float((after ^ before).sum()) / dot)
    return GROWTH_PENALTY * max(growth, 0.0) + SHRINKAGE_PENALTY * max(-growth, 0.0) + DOT_PENALTY * tiny


def _reach_of_click(view: ViewEvidence, before: np.ndarray, clicks: Clicks) -> np.ndarray:
    """Return the mask `before`, changed around contradicting clicks up to changes of color and edges of the relief."""
    lab, small, marks = downscale(view.image, clicks)
    before_small = cv2.resize(before.astype(np.float32), small[::-1], interpolation=cv2.INTER_AREA) > 0.5
    grid = pixel_pairs(small)
    depth_edges = find_depth_edges(view.relief, small, *grid)
    mask = correct_labels(lab, *grid, marks.ravel(), before_small.ravel(), depth_edges).reshape(small)
    same = upscale(mask == before_small, before.shape)
    return refine_edges(view.image, np.where(same, before, ~before), mark_pixels(clicks, before.shape))
