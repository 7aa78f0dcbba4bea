"""A hole put together from few large pieces of its own photograph, each moved as the photograph repeats itself.

Shifts between patches that look alike tell how (He and Sun 2012); pieces are cut where they agree. What a piece shows
must lie in space as the hole's surface does, and be about as far away. So paths and edges run on from one side to the
other, and grass stays as sharp as it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import ndimage

from reffusion.texture.blending import blended
from reffusion.texture.cutting import apart, assembled, expanded, looks, side_by_side
from reffusion.texture.offsets import frequent
from reffusion.texture.pieces import APART, CLEAR, MOST, values_of
from reffusion.texture.shown import Shown

OFFSETS = 60  # that are tried together
COVERS = 0.05  # share of the hole that one must cover
RING = 6  # px around the hole in which pieces are compared with what is known
KNOWN = 3.0  # weight of that comparison
ALIKE = 30.0  # levels that a difference of normals counts, where patches are compared
LIES = 20.0  # cost of a pixel by the squared difference of normals
DISTANCE, SAME_DISTANCE = 12.0, 0.3  # the same, for each time that it is twice as far away; not counted up to this
UNLIKE = 40.0  # both together at most: what is in the hole is a guess
UNKNOWN = 500.0  # cost of a pixel that an offset does not show
TONE, FINE = 0.4, 6.0  # weight of the difference from the tone around the hole, of what is blurred by so many pixels
OWN = 0.003  # weight of the pieces' own tone, blended


@dataclass(frozen=True)
class Moved:
    """A picture, uint8 [H, W, 3], which pixels of its hole are put together, bool [H, W], and what that costs: mean
    difference along cuts and from the ring, and of the tone, in levels by pixel."""

    image: np.ndarray
    filled: np.ndarray
    misfit: float


@dataclass(frozen=True)
class _Laid:
    """Pixels of the hole and the ring around it, [N] rows and columns, which are inside, and how far apart they lie."""

    rows: np.ndarray
    columns: np.ndarray
    inside: np.ndarray
    stride: int

    def at(self, offset: np.ndarray, clear: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """[N] rows and columns that an offset takes them from, and bool [N], whether these may be read."""
        height, width = clear.shape
        row, column = self.rows + offset[0], self.columns + offset[1]
        there = (row >= 0) & (column >= 0) & (row < height) & (column < width)
        row, column = row.clip(0, height - 1), column.clip(0, width - 1)
        return row, column, there & clear[row, column]


def shifted(target: Shown, hole: np.ndarray, own: Shown, seed: int = 0) -> Moved:
    """The target with its hole, bool [H, W], put together from pieces of its own photograph, `own`; not where no piece
    shows what it should.

    Args:
        target: its image is read outside the hole, and what it says of surfaces everywhere.
        seed: of the draw of patches that are compared.
    """
    missing = hole | target.masked
    colors, fine = values_of(target.image, missing)
    clear = ndimage.binary_erosion(~own.masked & ~missing, iterations=CLEAR) & own.usable
    near = ndimage.distance_transform_edt(~hole) <= RING if hole.any() else hole
    rows, columns = np.nonzero(near & (hole | ~target.masked))
    stride = max(1, int(np.ceil(np.sqrt(len(rows) / MOST))))
    some = (rows % stride == 0) & (columns % stride == 0)
    laid = _Laid(rows[some], columns[some], hole[rows[some], columns[some]], stride)
    offsets = frequent(np.concatenate([colors, ALIKE * target.normal], -1), clear, hole, seed)
    covers = lambda offset: laid.at(offset, clear)[2][laid.inside].mean() >= COVERS
    offsets = [offset for offset in offsets if covers(offset)][:OFFSETS]
    if not offsets or laid.inside.all():
        return Moved(target.image, np.zeros_like(hole), 0.0)
    taken, cost = _cut(laid, offsets, replace(target, image=colors), own, clear, hole, fine)
    label = np.full(hole.shape, -1)
    label[laid.rows, laid.columns] = taken
    nearest = ndimage.distance_transform_edt(label < 0, return_distances=False, return_indices=True)
    label = np.where(near, label[tuple(nearest)], -1)
    return Moved(*_drawn(target, hole, label, [(_moved(colors, o), _moved(clear, o)) for o in offsets]), cost)


def _cut(
    laid: _Laid,
    offsets: list[np.ndarray],
    target: Shown,
    own: Shown,
    clear: np.ndarray,
    hole: np.ndarray,
    fine: np.ndarray,
) -> tuple[np.ndarray, float]:
    """[N], the number of the offset that each pixel takes, and what that costs by pixel of the hole.

    Args: target: with its colours for image. clear: bool [H, W], what of `own` may be taken. fine: [H, W, 3].
    """
    here, colors, shape = (laid.rows, laid.columns), target.image, hole.shape
    tone = _blurred(colors, hole | target.masked)
    around = _around(tone, hole, target)[here]
    look_at = lambda row, column: looks(*here, colors[row, column], fine[row, column], shape, laid.stride)
    costs, seen = [], []
    for offset in offsets:
        row, column, there = laid.at(offset, clear)
        lies = ((target.normal[row, column] - target.normal[here]) ** 2).sum(1)
        farther = np.abs(np.log2(target.size[row, column] / target.size[here]))
        cost = np.minimum(LIES * lies + DISTANCE * np.maximum(farther - SAME_DISTANCE, 0), UNLIKE)
        cost += TONE * np.abs(tone[row, column] - around).mean(1)
        costs.append(np.where(there & (own.layer[row, column] == target.layer[here]), cost, UNKNOWN))
        seen.append(look_at(row, column))
    cost, look = np.array(costs), np.array(seen)
    off = KNOWN * np.minimum(apart(look, look_at(*here)), 2 * APART)
    cost += np.where(laid.inside | (cost >= UNKNOWN), 0, off)
    pairs = side_by_side(*here, shape, laid.stride)
    taken = expanded(cost, look, pairs)
    first, second = pairs.T
    seams = sum(apart(look[taken[first], at], look[taken[second], at]).sum() for at in (first, second))
    paid = cost[taken, np.arange(len(taken))]
    return np.where(paid < UNKNOWN, taken, len(offsets)), float((paid.sum() + seams) / laid.inside.sum())


def _drawn(
    target: Shown, hole: np.ndarray, label: np.ndarray, shown: list[tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """The picture and what of its hole is filled; what stands before the rest does not blend with it."""
    image, filled = target.image, np.zeros_like(hole)
    for k in np.unique(target.layer[hole]):
        mine = target.layer == k
        image, more = assembled(image, hole & mine, ~hole & mine & ~target.masked, label, shown, OWN)
        filled |= more
    return image, filled


def _moved(values: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """[H, W, ...]: at each pixel the value that lies an offset away; zero where that is outside."""
    found = np.zeros_like(values)
    (rows, from_rows), (columns, from_columns) = (
        (slice(max(0, -by), size - max(0, by)), slice(max(0, by), size - max(0, -by)))
        for by, size in zip(offset.tolist(), values.shape[:2], strict=True)
    )
    found[rows, columns] = values[from_rows, from_columns]
    return found


def _blurred(colors: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """[H, W, 3], the tone: the mean of what is known around."""
    known = (~missing).astype(np.float32)
    blur = lambda a: cv2.GaussianBlur(a, (0, 0), FINE).reshape(*missing.shape, -1)
    return blur(colors * known[..., None]) / np.maximum(blur(known), 1e-3)


def _around(tone: np.ndarray, hole: np.ndarray, target: Shown) -> np.ndarray:
    """[H, W, 3], the tone around the hole, drawn evenly across it; of what stands before the rest by itself."""
    found, even = tone.copy(), np.zeros_like(tone)
    for k in np.unique(target.layer[hole]):
        mine, beside = hole & (target.layer == k), ~hole & ~target.masked & (target.layer == k)
        if beside.any():
            found[mine] = blended(tone, mine, even, even, even, beside, 1e-9)
    return found
