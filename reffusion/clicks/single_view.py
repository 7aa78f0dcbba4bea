"""Segments a photograph by clicks and strokes, and moves the borders of masks to its edges.

Regions are proposed by colours and edges of surfaces, and by a segmentation network if there is one. The region is
selected whose border follows edges of surfaces and colours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from reffusion.clicks.geodesic_cut import correct_labels, grow_object, nested_candidates, object_score
from reffusion.clicks.marks import OBJECT, OTHER, Clicks, Mark, clicks_of, confirmed_pixels, mark_pixels, stroke_pixels
from reffusion.clicks.segmenter import Candidate, Prompt
from reffusion.morphology import disk

LONGEST = 192  # px, the larger side of the picture that is segmented
BAND = 0.008  # of the larger side: how far a photograph's edges may lie from the mask's border
DEPTH_SLOPE = 4.0, 10.0  # px of depth per px: largest slope of a surface, smallest slope of an edge between surfaces
LEAST_EDGE_SHARE = 0.25  # share of an object's border that must be an edge between surfaces, for depth to be used
LEAST_REGION = 12  # px of the segmented picture that a region with a click must have
RING = 0.25  # of the square root of a mask's pixels: width of the ring around it in which colours are compared
MARGIN = 3  # bands around a mask whose colours are used


@dataclass(frozen=True)
class ViewEvidence:
    """What is known of a view before anything is marked in it.

    Attributes:
        image: uint8 [H, W, 3].
        relief: [H, W], logarithm of the depth times the focal length in pixels; None: the scene is not fitted yet.
        ask: the masks of a segmentation network for a prompt, from parts to the whole; None: there is no network.
    """

    image: np.ndarray
    relief: np.ndarray | None = None
    ask: Callable[[Prompt], list[Candidate]] | None = None


def apply_marks(
    view: ViewEvidence, marks: Sequence[Mark], before: np.ndarray | None = None, first: int = 0
) -> np.ndarray:
    """bool [H, W]: the mask after marks are applied one after the other.

    A stroke changes the pixels below it. The first click on the object selects it; each later click adds or removes one
    connected region, which contains no pixel that earlier marks confirm to be otherwise. So a click never changes what
    is not connected with it.

    Args:
        before: bool [H, W], the mask that the marks correct; None: empty.
        first: index of the first mark that `before` does not contain.
    """
    shape = view.image.shape[:2]
    mask = np.zeros(shape, bool) if before is None else before
    for k in range(first, len(marks)):
        mark = marks[k]
        if mark.radius:
            painted = stroke_pixels(mark, shape)
            mask = mask | painted if mark.positive else mask & ~painted
            continue
        for i in range(len(mark.points)):
            done = [*marks[:k], Mark(mark.points[: i + 1], mark.positive)]
            if mask.any():
                mask = correct_mask(view, mask, clicks_of(done), confirmed_pixels(done, shape))
            elif mark.positive:
                mask = segment_view(view, clicks_of(done))
    return mask


def segment_view(view: ViewEvidence, clicks: Clicks) -> np.ndarray:
    """bool [H, W], True = the object that clicks are on; empty without a click on the object."""
    if not clicks.positive.any():
        return np.zeros(view.image.shape[:2], bool)
    own, *others = _propose(view, clicks)
    # The network's first mask is of a part; one click rarely means that.
    best = _most_object(view, clicks, [own, *others[1:]])
    return own if best is None else best


def correct_mask(view: ViewEvidence, before: np.ndarray, clicks: Clicks, confirmed: np.ndarray) -> np.ndarray:
    """bool [H, W]: the mask `before` [H, W] with one region added or removed by the last click, if that contradicts it.

    Args:
        confirmed: int8 [H, W], the pixels of all marks, see `marks.confirmed_pixels`.
    """
    at, positive = clicks.points[-1], bool(clicks.positive[-1])
    if _value_at(before, at) == positive:
        return before
    reach = _reach_of_click(view, before, clicks)
    masks = [reach, *_propose(view, clicks)]
    alone = Clicks(
        np.concatenate([clicks.points[clicks.positive != positive], at[None]]),
        np.append(np.zeros((clicks.positive != positive).sum(), bool), True),
    )
    masks += [mask if positive else ~mask for mask in _propose(view, alone)]
    results, kept = [], confirmed == (OTHER if positive else OBJECT)
    for mask in masks:
        region = _part_at((mask & ~before if positive else before & ~mask) & ~kept, at)
        if region.any():
            results.append(before | region if positive else before & ~region)
    if not results:
        return before
    best = _most_object(view, clicks, results)
    return results[0] if best is None else best


def _propose(view: ViewEvidence, clicks: Clicks) -> list[np.ndarray]:
    """bool [H, W] each: the object by colours and surfaces, and by the network; empty without a click on the object."""
    if not clicks.positive.any():
        return []
    own = segment_by_surfaces(view.image, clicks, view.relief)
    if view.ask is None:
        return [own]
    masks = [own, *(each.mask for each in view.ask(Prompt(clicks)))]
    return [*masks, view.ask(Prompt(clicks, bounding_box(own)))[-1].mask] if own.any() else masks


def _most_object(view: ViewEvidence, clicks: Clicks, masks: Sequence[np.ndarray]) -> np.ndarray | None:
    """The mask that is most an object of its own, of those that agree with the clicks; None if none does."""
    agreeing = [
        mask
        for mask in masks
        if all(_value_at(mask, at) == positive for at, positive in zip(clicks.points, clicks.positive, strict=True))
    ]
    if len(agreeing) < 2:
        return agreeing[0] if agreeing else None
    lab, small, _ = _downscale(view.image, clicks)
    pairs, length = _pixel_pairs(small)
    edges = _find_depth_edges(view.relief, small, pairs, length)
    depth_edges = np.zeros(len(pairs)) if edges is None else edges

    def merit(mask: np.ndarray) -> float:
        labels = cv2.resize(mask.astype(np.float32), small[::-1], interpolation=cv2.INTER_AREA) > 0.5
        ends = labels.ravel()[pairs]
        rim = ends[:, 0] != ends[:, 1]
        on_edges = float(depth_edges[rim].mean()) if rim.any() else 0.0
        return object_score(labels.ravel(), _ring(labels).ravel(), lab, pairs, depth_edges) + on_edges

    return max(agreeing, key=merit)


def _value_at(mask: np.ndarray, at: np.ndarray) -> bool:
    column, row = (int(each) for each in at)
    return bool(mask[min(row, mask.shape[0] - 1), min(column, mask.shape[1] - 1)])


def _part_at(mask: np.ndarray, at: np.ndarray) -> np.ndarray:
    """bool [H, W]: the connected part of a mask that a point lies in; empty if the point lies outside."""
    if not _value_at(mask, at):
        return np.zeros_like(mask)
    parts, _ = ndimage.label(mask, np.ones((3, 3)))
    return parts == parts[min(int(at[1]), mask.shape[0] - 1), min(int(at[0]), mask.shape[1] - 1)]


def bounding_box(mask: np.ndarray) -> tuple[float, float, float, float]:
    """(left, top, right, bottom) of a mask that is not empty, px."""
    rows, columns = np.nonzero(mask)
    return float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1)


def segment_by_surfaces(image: np.ndarray, clicks: Clicks, relief: np.ndarray | None = None) -> np.ndarray:
    """bool [H, W], True = the object that clicks are on, by colours and edges of surfaces; at least one is positive.

    Args:
        image: uint8 [H, W, 3].
        clicks: in its pixels.
        relief: [H, W], logarithm of the depth times the focal length in pixels, where the scene has been fitted.
    """
    shape = image.shape[:2]
    lab, small, marks = _downscale(image, clicks)
    border = np.ones(small, bool)
    border[1:-1, 1:-1] = False
    pairs, length = _pixel_pairs(small)
    depth_edges, found = _find_depth_edges(relief, small, pairs, length), None
    problem = lab, pairs, length, marks.ravel(), border.ravel()
    if depth_edges is not None:
        candidates = [*nested_candidates(*problem, depth_edges), grow_object(*problem, depth_edges)]
        found = _select_object(candidates, marks, lab, pairs, depth_edges)
    mask = _fill_holes(grow_object(*problem), marks) if found is None else found
    return refine_edges(image, _upscale(mask, shape), mark_pixels(clicks, shape))


def _select_object(
    candidates: list[np.ndarray], marks: np.ndarray, lab: np.ndarray, pairs: np.ndarray, depth_edges: np.ndarray
) -> np.ndarray | None:
    """bool [h, w]: the labels among several that are most an object of its own; None where depth shows no edge around
    it.

    Arguments as in `geodesic_cut`; marks are [h, w].
    """
    whole = [each for each in (_fill_holes(labels, marks) for labels in candidates) if _has_regions(each, marks)]
    if not whole:
        return None
    merits = [object_score(each.ravel(), _ring(each).ravel(), lab, pairs, depth_edges) for each in whole]
    best = whole[int(np.argmax(merits))]
    rim = best.ravel()[pairs[:, 0]] != best.ravel()[pairs[:, 1]]
    return best if max(merits) > -np.inf and depth_edges[rim].mean() >= LEAST_EDGE_SHARE else None


def _has_regions(mask: np.ndarray, marks: np.ndarray) -> bool:
    """Is the region around each mark larger than the mark itself?"""
    for side, kind in ((mask, OBJECT), (~mask, OTHER)):
        parts, _ = ndimage.label(side, np.ones((3, 3)))
        if np.bincount(parts.ravel())[parts[(marks == kind) & side]].min(initial=LEAST_REGION) < LEAST_REGION:
            return False
    return True


def _fill_holes(labels: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """bool [h, w]: labels with those holes filled that no mark lies in."""
    mask = labels.reshape(marks.shape)
    return mask | (ndimage.binary_fill_holes(mask) & ~_marked_holes(marks == OTHER, mask))


def _ring(mask: np.ndarray) -> np.ndarray:
    """bool [h, w], a ring around a mask whose width grows with its size."""
    far = max(3, round(RING * float(np.sqrt(mask.sum()))))
    return ~erode(~mask, far) & erode(~mask, 1)


def _reach_of_click(view: ViewEvidence, before: np.ndarray, clicks: Clicks) -> np.ndarray:
    """bool [H, W]: the mask `before`, corrected by clicks that contradict it. A correction extends to where colours
    change, and to the edges of surfaces where their relief is known."""
    lab, small, marks = _downscale(view.image, clicks)
    before_small = cv2.resize(before.astype(np.float32), small[::-1], interpolation=cv2.INTER_AREA) > 0.5
    grid = _pixel_pairs(small)
    depth_edges = _find_depth_edges(view.relief, small, *grid)
    mask = correct_labels(lab, *grid, marks.ravel(), before_small.ravel(), depth_edges).reshape(small)
    same = _upscale(mask == before_small, before.shape)
    return refine_edges(view.image, np.where(same, before, ~before), mark_pixels(clicks, before.shape))


def _downscale(image: np.ndarray, clicks: Clicks) -> tuple[np.ndarray, tuple[int, int], np.ndarray]:
    """The picture at the size for segmentation: colours [P, 3] in L*a*b*, (height, width), marks int8 [h, w]."""
    factor = min(1.0, LONGEST / max(image.shape[:2]))
    height, width = (max(1, round(side * factor)) for side in image.shape[:2])
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB).reshape(-1, 3).astype(np.float64)
    at = Clicks(clicks.points * (width / image.shape[1], height / image.shape[0]), clicks.positive)
    return lab, (height, width), mark_pixels(at, (height, width))


def _upscale(mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return cv2.resize(mask.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5


def refine_edges(image: np.ndarray, mask: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """bool [H, W]: the mask with its border moved to where colours change, at most by `BAND`; marks [H, W] stay."""
    if not mask.any():
        return mask
    band = max(1, round(BAND * max(mask.shape)))
    inner, outer = erode(mask, band), ~erode(~mask, band)
    reach = MARGIN * band
    window = tuple(slice(max(0, each.min() - reach), each.max() + reach + 1) for each in np.nonzero(outer))
    state = np.where(mask, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    state[inner | (marks == OBJECT)], state[~outer | (marks == OTHER)] = cv2.GC_FGD, cv2.GC_BGD
    cut, models = state[window].copy(), (np.zeros((1, 65)), np.zeros((1, 65)))
    sides = np.isin(cut, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if min(sides.sum(), (~sides).sum()) < 10:  # too few pixels for a model of colours
        return mask
    cv2.setRNGSeed(0)
    cv2.grabCut(np.ascontiguousarray(image[window][..., ::-1]), cut, None, *models, 1, cv2.GC_INIT_WITH_MASK)
    found = mask.copy()
    found[window] = np.isin(cut, (cv2.GC_FGD, cv2.GC_PR_FGD))
    return found


def erode(mask: np.ndarray, by: int) -> np.ndarray:
    kernel = disk(by)
    return cv2.erode(mask.astype(np.uint8), kernel, borderValue=1) > 0


def _find_depth_edges(
    relief: np.ndarray | None, small: tuple[int, int], pairs: np.ndarray, length: np.ndarray
) -> np.ndarray | None:
    """[E] in [0, 1]: how surely neighbours lie on two surfaces, one behind the other; relief as for `segment_view`."""
    if relief is None:
        return None
    size = small[::-1]
    seen = cv2.resize(relief.astype(np.float32), size, interpolation=cv2.INTER_AREA) * (size[0] / relief.shape[1])
    seen = cv2.medianBlur(seen, 3).ravel()
    slope = np.abs(seen[pairs[:, 0]] - seen[pairs[:, 1]]) / length
    return ((slope - DEPTH_SLOPE[0]) / (DEPTH_SLOPE[1] - DEPTH_SLOPE[0])).clip(0, 1)


def _marked_holes(marks: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """bool [H, W]: the holes of the mask that marks lie in."""
    holes, _ = ndimage.label(~mask)
    return np.isin(holes, holes[marks & ~mask])


def _pixel_pairs(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Pairs [E, 2] of neighbouring pixels (8-neighbourhood), and their distances [E] in pixels."""
    index, pairs, length = np.arange(shape[0] * shape[1]).reshape(shape), [], []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        width = shape[1] - abs(right)
        first = index[: shape[0] - down, max(0, -right) :][:, :width]
        second = index[down:, max(0, right) :][:, :width]
        pairs.append(np.stack([first.ravel(), second.ravel()], 1))
        length.append(np.full(first.size, np.hypot(down, right)))
    return np.concatenate(pairs), np.concatenate(length)
