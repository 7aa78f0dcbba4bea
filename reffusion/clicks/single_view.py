"""Segmentation of one photograph by clicks and strokes, and refinement of a mask's border along edges of a photograph.

Cuts along colours and edges of surfaces propose regions, and so does a segmentation network if there is one. The
proposed region whose border best follows edges of surfaces and of colours is selected.
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
BAND = 0.008  # share of the larger side: how far `refine_edges` may move a mask's border
# Slope of the relief (`ViewEvidence.relief`) in px per px: the largest within a surface, and the smallest of a certain
# edge between two surfaces.
DEPTH_SLOPE = 4.0, 10.0
LEAST_EDGE_SHARE = 0.25  # share of an object's border that must be an edge between surfaces, for depth to be used
LEAST_REGION = 12  # number of pixels (at the size for segmentation) that a region with a click must have
RING = 0.25  # width of the ring around a mask in which colours are compared, per square root of the mask's pixels
# Penalties on a correction's merit: for each unit by which the logarithm of the mask's size grows or shrinks, and for
# changing a dot around the click only, which is right if all proposed regions are too large.
GROWTH_PENALTY, SHRINKAGE_PENALTY, DOT_PENALTY = 0.25, 0.15, 0.3
MARGIN = 3  # `refine_edges` uses the colours up to this many bands (`BAND`) away from a mask


@dataclass(frozen=True)
class ViewEvidence:
    """The data of a view from which it is segmented.

    Attributes:
        image: uint8 [H, W, 3], the undistorted photograph.
        relief: float [H, W], the natural logarithm of the depth, times the focal length in pixels; None if the scene is
            not fitted yet.
        ask: function from a prompt to the masks of a segmentation network, ordered from a part of the object to the
            whole object; None if there is no network.
    """

    image: np.ndarray
    relief: np.ndarray | None = None
    ask: Callable[[Prompt], list[Candidate]] | None = None


def apply_marks(
    view: ViewEvidence, marks: Sequence[Mark], before: np.ndarray | None = None, first: int = 0
) -> np.ndarray:
    """Return bool [H, W], the mask after marks are applied one after the other.

    A stroke changes the pixels below the brush. While the mask is empty, a click on the object selects the object. Each
    later click adds or removes one connected region around the clicked pixel. The region contains no pixel that
    earlier marks confirm to be the opposite. So a click never changes pixels that are not connected with it.

    Args:
        marks: all marks of the view, in the order in which they were made.
        before: bool [H, W], the mask after the marks before `first`; None for an empty mask.
        first: index of the first mark that is not yet applied in `before`.
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
    """Return bool [H, W], True = the object that the positive clicks are on; all False without a positive click."""
    if not clicks.positive.any():
        return np.zeros(view.image.shape[:2], bool)
    own, *others = _propose(view, clicks)
    # The network's first mask shows a part of an object. A click rarely means a part, so this mask is left out.
    best = _most_object(view, clicks, [own, *others[1:]])
    return own if best is None else best


def correct_mask(view: ViewEvidence, before: np.ndarray, clicks: Clicks, confirmed: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the mask `before` with one connected region added or removed around the last click.

    A positive click adds a region, a negative click removes one. Small changes are preferred. The mask is returned
    unchanged if it agrees with the last click already.

    Args:
        before: bool [H, W], the mask to correct.
        clicks: all clicks of the view; the last one is applied.
        confirmed: int8 [H, W], the pixels of all marks, from `marks.confirmed_pixels`. Pixels that are confirmed to be
            the opposite of the last click do not change.
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
    kept = confirmed == (OTHER if positive else OBJECT)
    regions = [_part_at((mask & ~before if positive else before & ~mask) & ~kept, at) for mask in masks]
    inside = at.clip(0.5, np.array(before.shape[::-1]) - 0.5)  # a click outside the picture is moved to its border
    dot = stroke_pixels(Mark(inside[None], positive, max(2.0, BAND * max(before.shape))), before.shape)
    regions.append((dot & ~before if positive else dot & before) & ~kept)
    results = [before | region if positive else before & ~region for region in regions if region.any()]
    opposite = clicks.points[clicks.positive != positive]
    whole = [result for result in results[:-1] if not _isolates_click(before, result, opposite, int(dot.sum()))]
    results = [*whole, results[-1]]
    penalties = [_change_penalty(before, result, int(dot.sum())) for result in results[:-1]] + [DOT_PENALTY]
    best = _most_object(view, clicks, results, penalties)
    return results[0] if best is None else best


def _isolates_click(before: np.ndarray, after: np.ndarray, points: np.ndarray, least: int) -> bool:
    """Return True if a correction leaves only a speck of the region that an earlier click is on.

    Args:
        before, after: bool [H, W], the mask before and after the correction.
        points: float [n, 2], the earlier clicks, all positive or all negative, in pixels.
        least: number of pixels below which a connected region is a speck.
    """

    def is_speck(mask: np.ndarray, at: np.ndarray) -> bool:
        return bool(_part_at(mask == _value_at(before, at), at).sum() < least)

    return any(is_speck(after, at) and not is_speck(before, at) for at in points)


def _change_penalty(before: np.ndarray, after: np.ndarray, dot: int) -> float:
    """Return the penalty on a correction's merit, which grows with the change of the mask's size.

    A change smaller than a dot around the click is hardly what a person clicks on, so it is penalised, too.

    Args:
        before, after: bool [H, W], the mask before and after the correction.
        dot: number of pixels of the dot.
    """
    growth = float(np.log(max(after.sum(), 1) / max(before.sum(), 1)))
    tiny = max(0.0, 1 - float((after ^ before).sum()) / dot)
    return GROWTH_PENALTY * max(growth, 0.0) + SHRINKAGE_PENALTY * max(-growth, 0.0) + DOT_PENALTY * tiny


def _propose(view: ViewEvidence, clicks: Clicks) -> list[np.ndarray]:
    """Return masks of the object that the positive clicks are on, bool [H, W] each; no mask without a positive click.

    The first mask is found by colours and surfaces. The network's masks follow, if there is a network: all masks for
    the clicks, from part to whole, and the mask of the whole object for the clicks and the first mask's bounding box.
    """
    if not clicks.positive.any():
        return []
    own = segment_by_surfaces(view.image, clicks, view.relief)
    if view.ask is None:
        return [own]
    masks = [own, *(each.mask for each in view.ask(Prompt(clicks)))]
    return [*masks, view.ask(Prompt(clicks, bounding_box(own)))[-1].mask] if own.any() else masks


def _most_object(
    view: ViewEvidence, clicks: Clicks, masks: Sequence[np.ndarray], penalties: Sequence[float] | None = None
) -> np.ndarray | None:
    """Return the mask that best outlines one complete object, among the masks that agree with all clicks.

    The merit of a mask is its `object_score`, plus the share of its border that lies on edges of surfaces, minus its
    penalty. None if no mask agrees with all clicks.

    Args:
        penalties: of each mask; None for no penalties.
    """
    agreeing = [
        k
        for k, mask in enumerate(masks)
        if all(_value_at(mask, at) == positive for at, positive in zip(clicks.points, clicks.positive, strict=True))
    ]
    if len(agreeing) < 2:
        return masks[agreeing[0]] if agreeing else None
    lab, small, _ = _downscale(view.image, clicks)
    pairs, length = _pixel_pairs(small)
    edges = _find_depth_edges(view.relief, small, pairs, length)
    depth_edges = np.zeros(len(pairs)) if edges is None else edges

    def merit(k: int) -> float:
        labels = cv2.resize(masks[k].astype(np.float32), small[::-1], interpolation=cv2.INTER_AREA) > 0.5
        ends = labels.ravel()[pairs]
        rim = ends[:, 0] != ends[:, 1]
        on_edges = float(depth_edges[rim].mean()) if rim.any() else 0.0
        score = object_score(labels.ravel(), _ring(labels).ravel(), lab, pairs, depth_edges) + on_edges
        return score - (penalties[k] if penalties else 0.0)

    return masks[max(agreeing, key=merit)]


def _value_at(mask: np.ndarray, at: np.ndarray) -> bool:
    column, row = (int(each) for each in at)
    return bool(mask[min(row, mask.shape[0] - 1), min(column, mask.shape[1] - 1)])


def _part_at(mask: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the connected part of a mask that contains a point; all False if the mask does not contain
    the point.

    Args:
        at: (x, y) in pixels.
    """
    if not _value_at(mask, at):
        return np.zeros_like(mask)
    parts, _ = ndimage.label(mask, np.ones((3, 3)))
    return parts == parts[min(int(at[1]), mask.shape[0] - 1), min(int(at[0]), mask.shape[1] - 1)]


def bounding_box(mask: np.ndarray) -> tuple[float, float, float, float]:
    """Return (left, top, right, bottom) of a mask that is not empty, in pixels; right and bottom are exclusive."""
    rows, columns = np.nonzero(mask)
    return float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1)


def segment_by_surfaces(image: np.ndarray, clicks: Clicks, relief: np.ndarray | None = None) -> np.ndarray:
    """Return bool [H, W], True = the object that the positive clicks are on, found without a segmentation network.

    Colours and edges of surfaces are used. Colours alone are used if depth is unknown, or shows no edge around the
    object.

    Args:
        image: uint8 [H, W, 3].
        clicks: clicks in pixels of the image, at least one of them positive.
        relief: float [H, W] as in `ViewEvidence`; None if the scene is not fitted yet.
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
    """Return bool [h, w], the candidate that best outlines one complete object by `object_score`.

    None if depth shows no edge around this candidate, or if no candidate has regions as large as `_has_regions` asks.

    Args:
        candidates: labels of the pixels, bool [h * w] each.
        marks: int8 [h, w], OBJECT, OTHER or UNKNOWN.
        lab, pairs, depth_edges: as in `geodesic_cut.grow_object`.
    """
    whole = [each for each in (_fill_holes(labels, marks) for labels in candidates) if _has_regions(each, marks)]
    if not whole:
        return None
    merits = [object_score(each.ravel(), _ring(each).ravel(), lab, pairs, depth_edges) for each in whole]
    best = whole[int(np.argmax(merits))]
    rim = best.ravel()[pairs[:, 0]] != best.ravel()[pairs[:, 1]]
    return best if max(merits) > -np.inf and depth_edges[rim].mean() >= LEAST_EDGE_SHARE else None


def _has_regions(mask: np.ndarray, marks: np.ndarray) -> bool:
    """Return True if each marked pixel lies in a connected region of at least `LEAST_REGION` pixels.

    Positive marks are looked up in the regions of the mask, negative marks in the regions outside the mask. A mark that
    the mask contradicts is not counted.
    """
    for side, kind in ((mask, OBJECT), (~mask, OTHER)):
        parts, _ = ndimage.label(side, np.ones((3, 3)))
        if np.bincount(parts.ravel())[parts[(marks == kind) & side]].min(initial=LEAST_REGION) < LEAST_REGION:
            return False
    return True


def _fill_holes(labels: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """Return bool [h, w], the labels with holes filled, except holes that contain a negative mark.

    Args:
        labels: bool [h * w].
        marks: int8 [h, w], OBJECT, OTHER or UNKNOWN.
    """
    mask = labels.reshape(marks.shape)
    return mask | (ndimage.binary_fill_holes(mask) & ~_marked_holes(marks == OTHER, mask))


def _ring(mask: np.ndarray) -> np.ndarray:
    """Return bool [h, w], a ring around a mask, wider for larger masks and one pixel away from the mask."""
    far = max(3, round(RING * float(np.sqrt(mask.sum()))))
    return ~erode(~mask, far) & erode(~mask, 1)


def _reach_of_click(view: ViewEvidence, before: np.ndarray, clicks: Clicks) -> np.ndarray:
    """Return bool [H, W], the mask `before`, corrected around the clicks that contradict it.

    A correction extends up to changes of colour, and up to edges of surfaces if the view has a relief.
    """
    lab, small, marks = _downscale(view.image, clicks)
    before_small = cv2.resize(before.astype(np.float32), small[::-1], interpolation=cv2.INTER_AREA) > 0.5
    grid = _pixel_pairs(small)
    depth_edges = _find_depth_edges(view.relief, small, *grid)
    mask = correct_labels(lab, *grid, marks.ravel(), before_small.ravel(), depth_edges).reshape(small)
    same = _upscale(mask == before_small, before.shape)
    return refine_edges(view.image, np.where(same, before, ~before), mark_pixels(clicks, before.shape))


def _downscale(image: np.ndarray, clicks: Clicks) -> tuple[np.ndarray, tuple[int, int], np.ndarray]:
    """Reduce a picture and its clicks to the size for segmentation, at most `LONGEST` px on the larger side.

    Returns:
        Colours float64 [h * w, 3] in 8-bit L*a*b*; (h, w); marks int8 [h, w], OBJECT, OTHER or UNKNOWN.
    """
    factor = min(1.0, LONGEST / max(image.shape[:2]))
    height, width = (max(1, round(side * factor)) for side in image.shape[:2])
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB).reshape(-1, 3).astype(np.float64)
    at = Clicks(clicks.points * (width / image.shape[1], height / image.shape[0]), clicks.positive)
    return lab, (height, width), mark_pixels(at, (height, width))


def _upscale(mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return cv2.resize(mask.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5


def refine_edges(image: np.ndarray, mask: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the mask with its border moved to changes of colour by GrabCut.

    The border moves by at most the share `BAND` of the larger image side. The mask is returned unchanged if the mask or
    its surroundings have fewer than 10 pixels.

    Args:
        image: uint8 [H, W, 3].
        mask: bool [H, W].
        marks: int8 [H, W]; GrabCut keeps the pixels marked OBJECT inside the mask and those marked OTHER outside.
    """
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
    """Return the mask, bool [H, W], eroded by a disk with a radius of `by` px. The image's border does not erode it."""
    kernel = disk(by)
    return cv2.erode(mask.astype(np.uint8), kernel, borderValue=1) > 0


def _find_depth_edges(
    relief: np.ndarray | None, small: tuple[int, int], pairs: np.ndarray, length: np.ndarray
) -> np.ndarray | None:
    """Return [E] in [0, 1], how surely the two pixels of a pair lie on different surfaces, one behind the other.

    Args:
        relief: float [H, W] as in `ViewEvidence`; None if the scene is not fitted yet, which gives None.
        small: (h, w), the size for segmentation.
        pairs: int [E, 2], neighbouring pixels at this size.
        length: [E], their distances in pixels.
    """
    if relief is None:
        return None
    size = small[::-1]
    seen = cv2.resize(relief.astype(np.float32), size, interpolation=cv2.INTER_AREA) * (size[0] / relief.shape[1])
    seen = cv2.medianBlur(seen, 3).ravel()
    slope = np.abs(seen[pairs[:, 0]] - seen[pairs[:, 1]]) / length
    return ((slope - DEPTH_SLOPE[0]) / (DEPTH_SLOPE[1] - DEPTH_SLOPE[0])).clip(0, 1)


def _marked_holes(marks: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the connected parts outside the mask that contain a marked pixel.

    Args:
        marks: bool [H, W], True = marked.
        mask: bool [H, W].
    """
    holes, _ = ndimage.label(~mask)
    return np.isin(holes, holes[marks & ~mask])


def _pixel_pairs(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs int [E, 2] of neighbouring pixels (8-neighbourhood), and their distances [E] in pixels.

    Pixels are numbered row by row.

    Args:
        shape: (height, width).
    """
    index, pairs, length = np.arange(shape[0] * shape[1]).reshape(shape), [], []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        width = shape[1] - abs(right)
        first = index[: shape[0] - down, max(0, -right) :][:, :width]
        second = index[down:, max(0, right) :][:, :width]
        pairs.append(np.stack([first.ravel(), second.ravel()], 1))
        length.append(np.full(first.size, np.hypot(down, right)))
    return np.concatenate(pairs), np.concatenate(length)
