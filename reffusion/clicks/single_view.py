"""Segments a photograph by clicks, in about a second on one core; and moves the borders of masks to its edges."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from reffusion.clicks.geodesic_cut import correct_labels, grow_object, nested_candidates, object_score
from reffusion.clicks.marks import OBJECT, OTHER, UNKNOWN, Clicks, mark_pixels
from reffusion.morphology import disk

LONGEST = 192  # px, the larger side of the picture that is segmented
BAND = 0.008  # of the larger side: how far a photograph's edges may lie from the mask's border
DEPTH_SLOPE = 4.0, 10.0  # px of depth per px: largest slope of a surface, smallest slope of an edge between surfaces
LEAST_EDGE_SHARE = 0.25  # share of an object's border that must be an edge between surfaces, for depth to be used
LEAST_REGION = 12  # px of the segmented picture that a region with a click must have
RING = 0.25  # of the square root of a mask's pixels: width of the ring around it in which colours are compared
MARGIN = 3  # bands around a mask whose colours are used


def segment_view(image: np.ndarray, clicks: Clicks, relief: np.ndarray | None = None) -> np.ndarray:
    """bool [H, W], True = the object that clicks are on; empty without a click on the object.

    Args:
        image: uint8 [H, W, 3].
        clicks: in its pixels.
        relief: [H, W], logarithm of the depth times the focal length in pixels, where the scene has been fitted.
    """
    shape = image.shape[:2]
    if not clicks.positive.any():
        return np.zeros(shape, bool)
    lab, small, marks = _downscale(image, clicks)
    border = np.ones(small, bool)
    border[1:-1, 1:-1] = False
    pairs, length = _pixel_pairs(small)
    depth_edges, given = (
        _find_depth_edges(relief, small, pairs, length),
        (lab, pairs, length, marks.ravel(), border.ravel()),
    )
    found = (
        None
        if depth_edges is None
        else _select_object(
            [*nested_candidates(*given, depth_edges), grow_object(*given, depth_edges)], marks, lab, pairs, depth_edges
        )
    )
    mask = _fill_holes(grow_object(*given), marks) if found is None else found
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


def correct_mask(image: np.ndarray, before: np.ndarray, clicks: Clicks, relief: np.ndarray | None = None) -> np.ndarray:
    """bool [H, W]: the mask `before` [H, W], corrected by clicks that contradict it. A correction extends to where
    colours change, and to the edges of surfaces where their relief is known."""
    lab, small, marks = _downscale(image, clicks)
    before_small = cv2.resize(before.astype(np.float32), small[::-1], interpolation=cv2.INTER_AREA) > 0.5
    wrong = np.where((marks == OBJECT) & ~before_small | (marks == OTHER) & before_small, marks, UNKNOWN)
    if not wrong.any():
        return refine_edges(image, before, mark_pixels(clicks, before.shape))
    grid = _pixel_pairs(small)
    mask = correct_labels(
        lab, *grid, marks.ravel(), before_small.ravel(), _find_depth_edges(relief, small, *grid)
    ).reshape(small)
    same = _upscale(mask == before_small, before.shape)
    return refine_edges(image, np.where(same, before, ~before), mark_pixels(clicks, before.shape))


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
