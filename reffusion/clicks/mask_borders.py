"""Borders of masks: refinement along edges of a photograph, cutting out a box, erosion, bounding box."""

from __future__ import annotations

import cv2
import numpy as np

from reffusion.clicks.marks import OBJECT, OTHER
from reffusion.morphology import disk

BAND = 0.008  # share of the larger side: how far `refine_edges` may move a mask's border
LEAST_PIXELS = 10  # least number of pixels for a model of their colors
MARGIN = 3  # `refine_edges` uses the colors up to this many bands (`BAND`) away from a mask


def bounding_box(mask: np.ndarray) -> tuple[float, float, float, float]:
    """Return (left, top, right, bottom) of a mask that is not empty, in pixels; right and bottom are exclusive."""
    rows, columns = np.nonzero(mask)
    return float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1)


def refine_edges(image: np.ndarray, mask: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the mask with its border moved to changes of color by GrabCut.

    The border moves by at most the share `BAND` of the larger image side. The mask is returned as it is if the mask or
    its surroundings have fewer than `LEAST_PIXELS` pixels.

    Args:
        image: uint8 [H, W, 3].
        mask: bool [H, W].
        marks: int8 [H, W] as from `mark_pixels`; OBJECT pixels stay inside the mask, and OTHER pixels outside.
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
    if min(sides.sum(), (~sides).sum()) < LEAST_PIXELS:
        return mask
    cv2.setRNGSeed(0)
    cv2.grabCut(np.ascontiguousarray(image[window][..., ::-1]), cut, None, *models, 1, cv2.GC_INIT_WITH_MASK)
    found = mask.copy()
    found[window] = np.isin(cut, (cv2.GC_FGD, cv2.GC_PR_FGD))
    return found


def find_thing_in_box(image: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the thing inside a box, found by GrabCut: its colors are rare around the box.

    Colors are compared up to the box's own size away from the box. The result is empty if the box or its surroundings
    have fewer than `LEAST_PIXELS` pixels.

    Args:
        image: uint8 [H, W, 3].
        inside: bool [H, W], the pixels of the box, at least one.
    """
    left, top, right, bottom = (int(side) for side in bounding_box(inside))
    window = (
        slice(max(0, 2 * top - bottom), 2 * bottom - top),
        slice(max(0, 2 * left - right), 2 * right - left),
    )
    cut = np.where(inside[window], cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
    found = np.zeros_like(inside)
    if min((cut == cv2.GC_BGD).sum(), inside.sum()) >= LEAST_PIXELS:
        cv2.setRNGSeed(0)
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(np.ascontiguousarray(image[window][..., ::-1]), cut, None, *models, 5, cv2.GC_INIT_WITH_MASK)
        found[window] = cut == cv2.GC_PR_FGD
    return found


def erode(mask: np.ndarray, by: int) -> np.ndarray:
    """Return the mask, bool [H, W], eroded by a disk with a radius of `by` px. The image's border does not erode it."""
    kernel = disk(by)
    return cv2.erode(mask.astype(np.uint8), kernel, borderValue=1) > 0
