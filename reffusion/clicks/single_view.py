"""Clicks on one photograph to a mask of it, in about a second on one core; and masks moved to a photograph's edges."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from reffusion.clicks.geodesic_cut import enclosed, grown, merit, regrown
from reffusion.clicks.marks import OBJECT, OTHER, UNKNOWN, Clicks, marked

LONGEST = 192  # px, the larger side of the picture that is cut
BAND = 0.008  # of the picture's larger side: how far its edges may lie from the mask
STEEP = 4.0, 10.0  # px of depth a pixel: a surface still, and no surface any more
STANDS_OUT = 0.25  # share of an object's rim beyond which something lies behind, from which its relief is believed
HEEDED = 12  # px of the picture that is cut, around each click
RING = 0.25  # of the square root of a mask's pixels: how far around it colours are compared
MARGIN = 3  # bands around a mask whose colours count


def view_mask(image: np.ndarray, clicks: Clicks, relief: np.ndarray | None = None) -> np.ndarray:
    """bool [H, W], True = the object that clicks are on; empty without a click on the object.

    Args:
        image: uint8 [H, W, 3].
        clicks: in its pixels.
        relief: [H, W], logarithm of the depth times the focal length in pixels, where the scene has been fitted.
    """
    shape = image.shape[:2]
    if not clicks.positive.any():
        return np.zeros(shape, bool)
    lab, small, marks = _small(image, clicks)
    border = np.ones(small, bool)
    border[1:-1, 1:-1] = False
    pairs, length = _grid(small)
    torn, given = _torn(relief, small, pairs, length), (lab, pairs, length, marks.ravel(), border.ravel())
    found = None if torn is None else _standing([*enclosed(*given, torn), grown(*given, torn)], marks, lab, pairs, torn)
    mask = _whole(grown(*given), marks) if found is None else found
    return refined(image, _enlarged(mask, shape), marked(clicks, shape))


def _standing(
    some: list[np.ndarray], marks: np.ndarray, lab: np.ndarray, pairs: np.ndarray, torn: np.ndarray
) -> np.ndarray | None:
    """bool [h, w]: of some labels those that most stand for a thing of its own; None where the fit does not know one.
    Arguments as in `graph`, marks [h, w]."""
    whole = [each for each in (_whole(labels, marks) for labels in some) if _heeds(each, marks)]
    if not whole:
        return None
    merits = [merit(each.ravel(), _ring(each).ravel(), lab, pairs, torn) for each in whole]
    best = whole[int(np.argmax(merits))]
    rim = best.ravel()[pairs[:, 0]] != best.ravel()[pairs[:, 1]]
    return best if max(merits) > -np.inf and torn[rim].mean() >= STANDS_OUT else None


def _heeds(mask: np.ndarray, marks: np.ndarray) -> bool:
    """Is there more around each mark than the mark?"""
    for side, kind in ((mask, OBJECT), (~mask, OTHER)):
        parts, _ = ndimage.label(side, np.ones((3, 3)))
        if np.bincount(parts.ravel())[parts[(marks == kind) & side]].min(initial=HEEDED) < HEEDED:
            return False
    return True


def _whole(labels: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """bool [h, w]: labels without the holes that no mark lies in."""
    mask = labels.reshape(marks.shape)
    return mask | (ndimage.binary_fill_holes(mask) & ~_around(marks == OTHER, mask))


def _ring(mask: np.ndarray) -> np.ndarray:
    """bool [h, w], around a mask, as far as it is large."""
    far = max(3, round(RING * float(np.sqrt(mask.sum()))))
    return ~shrunk(~mask, far) & shrunk(~mask, 1)


def corrected(image: np.ndarray, before: np.ndarray, clicks: Clicks, relief: np.ndarray | None = None) -> np.ndarray:
    """bool [H, W]: the mask `before` [H, W] with what clicks say against it, which reaches to where colours change, and
    to the edges of surfaces where their relief is known."""
    lab, small, marks = _small(image, clicks)
    was = cv2.resize(before.astype(np.float32), small[::-1], interpolation=cv2.INTER_AREA) > 0.5
    wrong = np.where((marks == OBJECT) & ~was | (marks == OTHER) & was, marks, UNKNOWN)
    if not wrong.any():
        return refined(image, before, marked(clicks, before.shape))
    grid = _grid(small)
    mask = regrown(lab, *grid, marks.ravel(), was.ravel(), _torn(relief, small, *grid)).reshape(small)
    same = _enlarged(mask == was, before.shape)
    return refined(image, np.where(same, before, ~before), marked(clicks, before.shape))


def _small(image: np.ndarray, clicks: Clicks) -> tuple[np.ndarray, tuple[int, int], np.ndarray]:
    """The picture at the size in which it is cut: colours [P, 3] in L*a*b*, (height, width), marks int8 [h, w]."""
    factor = min(1.0, LONGEST / max(image.shape[:2]))
    height, width = (max(1, round(side * factor)) for side in image.shape[:2])
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB).reshape(-1, 3).astype(np.float64)
    at = Clicks(clicks.points * (width / image.shape[1], height / image.shape[0]), clicks.positive)
    return lab, (height, width), marked(at, (height, width))


def _enlarged(mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return cv2.resize(mask.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5


def refined(image: np.ndarray, mask: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """bool [H, W]: the mask with its rim where colours change, at most `BAND` away; marks [H, W] are kept."""
    if not mask.any():
        return mask
    band = max(1, round(BAND * max(mask.shape)))
    inner, outer = shrunk(mask, band), ~shrunk(~mask, band)
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


def shrunk(mask: np.ndarray, by: int) -> np.ndarray:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * by + 1,) * 2)
    return cv2.erode(mask.astype(np.uint8), kernel, borderValue=1) > 0


def _torn(
    relief: np.ndarray | None, small: tuple[int, int], pairs: np.ndarray, length: np.ndarray
) -> np.ndarray | None:
    """[E] in [0, 1]: how surely neighbours lie on two surfaces, one behind the other; `view_mask` has the relief."""
    if relief is None:
        return None
    size = small[::-1]
    seen = cv2.resize(relief.astype(np.float32), size, interpolation=cv2.INTER_AREA) * (size[0] / relief.shape[1])
    seen = cv2.medianBlur(seen, 3).ravel()
    slope = np.abs(seen[pairs[:, 0]] - seen[pairs[:, 1]]) / length
    return ((slope - STEEP[0]) / (STEEP[1] - STEEP[0])).clip(0, 1)


def _around(marks: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """bool [H, W]: the holes of the mask that marks lie in."""
    holes, _ = ndimage.label(~mask)
    return np.isin(holes, holes[marks & ~mask])


def _grid(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Pairs [E, 2] of neighbouring pixels, eight to each, and their distances [E] in pixels."""
    index, pairs, length = np.arange(shape[0] * shape[1]).reshape(shape), [], []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        width = shape[1] - abs(right)
        first = index[: shape[0] - down, max(0, -right) :][:, :width]
        second = index[down:, max(0, right) :][:, :width]
        pairs.append(np.stack([first.ravel(), second.ravel()], 1))
        length.append(np.full(first.size, np.hypot(down, right)))
    return np.concatenate(pairs), np.concatenate(length)
