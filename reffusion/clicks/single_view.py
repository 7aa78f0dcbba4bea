"""Segmentation of one photograph by clicks.

Cuts along colors and edges of surfaces propose regions, and so does a segmentation network if there is one. The
proposed region whose border best follows edges of surfaces and of colors is selected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from reffusion.clicks.geodesic_cut import grow_object, nested_candidates, object_score
from reffusion.clicks.marks import OBJECT, OTHER, Clicks, mark_pixels
from reffusion.clicks.mask_borders import bounding_box, erode, refine_edges
from reffusion.clicks.pixel_grid import downscale, find_depth_edges, pixel_pairs, upscale, value_at
from reffusion.clicks.segmenter import Candidate, Prompt
from reffusion.morphology import label_sizes

LEAST_EDGE_SHARE = 0.25  # share of an object's border that must be an edge between surfaces, for depth to be used
LEAST_REGION = 12  # number of pixels (at the size for segmentation) that a region with a click must have
RING = 0.25  # width of the ring around a mask in which colors are compared, per square root of the mask's pixels


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


def segment_view(view: ViewEvidence, clicks: Clicks, size: str = "") -> np.ndarray:
    """Return bool [H, W], True = the object that the positive clicks are on; all False without a positive click.

    Args:
        size: which of the proposed masks is taken, as for `Mark.size`.
    """
    if not clicks.positive.any():
        return np.zeros(view.image.shape[:2], bool)
    if size and view.ask is None:
        return segment_by_surfaces(view.image, clicks, view.relief, size)
    own, *others = masks = propose_masks(view, clicks)
    if size:
        return pick_by_size([masks[k] for k in _agreeing(clicks, masks)] or [own], size)
    # The network's first mask shows a part of an object. A click rarely means a part, so this mask is left out.
    best = select_object(view, clicks, [own, *others[1:]])
    return own if best is None else best


def pick_by_size(masks: Sequence[np.ndarray], size: str) -> np.ndarray:
    """Return the mask, bool [H, W], of a size among masks, at least one.

    Args:
        size: "small" or "large" for the mask with fewest or most pixels; "middle" for the one whose number of pixels is
            nearest to the geometric mean of these two.
    """
    areas = np.log([max(int(mask.sum()), 1) for mask in masks])
    wanted = {"small": areas.min(), "middle": (areas.min() + areas.max()) / 2, "large": areas.max()}[size]
    return masks[int(np.abs(areas - wanted).argmin())]


def _agreeing(clicks: Clicks, masks: Sequence[np.ndarray]) -> list[int]:
    """Return the indices of the masks that agree with all clicks."""
    agrees = lambda mask: all(
        value_at(mask, at) == sign for at, sign in zip(clicks.points, clicks.positive, strict=True)
    )
    return [k for k, mask in enumerate(masks) if agrees(mask)]


def propose_masks(view: ViewEvidence, clicks: Clicks) -> list[np.ndarray]:
    """Return masks of the object that the positive clicks are on, bool [H, W] each; no mask without a positive click.

    The first mask is found by colors and surfaces. The network's masks follow, if there is a network: all masks for
    the clicks, from part to whole, and, unless the first mask is empty, the mask of the whole object for the clicks and
    the first mask's bounding box. Masks may contradict clicks.
    """
    if not clicks.positive.any():
        return []
    own = segment_by_surfaces(view.image, clicks, view.relief)
    if view.ask is None:
        return [own]
    masks = [own, *(each.mask for each in view.ask(Prompt(clicks)))]
    return [*masks, view.ask(Prompt(clicks, bounding_box(own)))[-1].mask] if own.any() else masks


def select_object(
    view: ViewEvidence, clicks: Clicks, masks: Sequence[np.ndarray], penalties: Sequence[float] | None = None
) -> np.ndarray | None:
    """Return the mask that best outlines one complete object, among the masks that agree with all clicks.

    The merit of a mask is its `object_score`, plus the share of its border that lies on edges of surfaces, minus its
    penalty. The result is None if no mask agrees with all clicks.

    Args:
        penalties: the penalty of each mask; None for no penalties.
    """
    agreeing = _agreeing(clicks, masks)
    if len(agreeing) < 2:
        return masks[agreeing[0]] if agreeing else None
    lab, small, _ = downscale(view.image, clicks)
    pairs, length = pixel_pairs(small)
    edges = find_depth_edges(view.relief, small, pairs, length)
    depth_edges = np.zeros(len(pairs)) if edges is None else edges

    def merit(k: int) -> float:
        labels = cv2.resize(masks[k].astype(np.float32), small[::-1], interpolation=cv2.INTER_AREA) > 0.5
        ends = labels.ravel()[pairs]
        rim = ends[:, 0] != ends[:, 1]
        on_edges = float(depth_edges[rim].mean()) if rim.any() else 0.0
        score = object_score(labels.ravel(), _ring(labels).ravel(), lab, pairs, depth_edges) + on_edges
        return score - (penalties[k] if penalties else 0.0)

    return masks[max(agreeing, key=merit)]


def segment_by_surfaces(
    image: np.ndarray, clicks: Clicks, relief: np.ndarray | None = None, size: str = ""
) -> np.ndarray:
    """Return bool [H, W], True = the object that the positive clicks are on, found without a segmentation network.

    Colors and edges of surfaces are used. Colors alone are used if depth is unknown, or shows no edge around the
    object.

    Args:
        image: uint8 [H, W, 3].
        clicks: clicks in pixels of the image, at least one of them positive.
        relief: float [H, W] as in `ViewEvidence`; None if the scene is not fitted yet.
        size: which of the proposed regions is taken, as for `Mark.size`.
    """
    shape = image.shape[:2]
    lab, small, marks = downscale(image, clicks)
    border = np.ones(small, bool)
    border[1:-1, 1:-1] = False
    pairs, length = pixel_pairs(small)
    depth_edges, found = find_depth_edges(relief, small, pairs, length), None
    problem = lab, pairs, length, marks.ravel(), border.ravel()
    if size or depth_edges is not None:
        edges = np.zeros(len(pairs)) if depth_edges is None else depth_edges
        candidates = [*nested_candidates(*problem, edges), grow_object(*problem, depth_edges)]
        if size:
            found = pick_by_size([_fill_holes(labels, marks) for labels in candidates], size)
        else:
            found = _select_candidate(candidates, marks, lab, pairs, edges)
    mask = _fill_holes(grow_object(*problem), marks) if found is None else found
    return refine_edges(image, upscale(mask, shape), mark_pixels(clicks, shape))


def _select_candidate(
    candidates: list[np.ndarray], marks: np.ndarray, lab: np.ndarray, pairs: np.ndarray, depth_edges: np.ndarray
) -> np.ndarray | None:
    """Return the candidate [h, w] of best `object_score`; None if all have tiny regions, or it lacks edges in depth."""
    whole = [each for each in (_fill_holes(labels, marks) for labels in candidates) if _has_regions(each, marks)]
    if not whole:
        return None
    merits = [object_score(each.ravel(), _ring(each).ravel(), lab, pairs, depth_edges) for each in whole]
    best = whole[int(np.argmax(merits))]
    rim = best.ravel()[pairs[:, 0]] != best.ravel()[pairs[:, 1]]
    return best if max(merits) > -np.inf and depth_edges[rim].mean() >= LEAST_EDGE_SHARE else None


def _has_regions(mask: np.ndarray, marks: np.ndarray) -> bool:
    """Return whether every mark that agrees with the mask lies in a region of at least `LEAST_REGION` pixels."""
    for side, kind in ((mask, OBJECT), (~mask, OTHER)):
        parts, sizes = label_sizes(side, np.ones((3, 3)))
        if sizes[parts[(marks == kind) & side]].min(initial=LEAST_REGION) < LEAST_REGION:
            return False
    return True


def _fill_holes(labels: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """Return the labels [h * w] as a mask [h, w], with holes filled unless they contain a negative mark."""
    mask = labels.reshape(marks.shape)
    marked = ndimage.binary_propagation((marks == OTHER) & ~mask, mask=~mask)
    return mask | (ndimage.binary_fill_holes(mask) & ~marked)


def _ring(mask: np.ndarray) -> np.ndarray:
    """Return bool [h, w], a ring around a mask, wider for larger masks and one pixel away from the mask."""
    far = max(3, round(RING * float(np.sqrt(mask.sum()))))
    return ~erode(~mask, far) & erode(~mask, 1)
