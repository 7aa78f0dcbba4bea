"""A hole put together from few large pieces of its own photograph, each moved as the photograph repeats itself.

Shifts between patches that look alike tell how (He and Sun 2012); pieces are cut where they agree. What a piece shows
must lie in space as the hole's surface does, and be about as far away. So paths and edges run on from one side to the
other, and grass stays as sharp as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from reffusion.inpaint.plane_frames import inverse
from reffusion.inpaint.poisson import evenly
from reffusion.inpaint.shift_map.expansion import RING, UNKNOWN, apart, assembled, expanded, looks, side_by_side
from reffusion.inpaint.shift_map.offsets import frequent
from reffusion.inpaint.shift_map.plane_motions import APART, CLEAR, COMPARED, MOST, values_of
from reffusion.inpaint.source_image import Shown

OFFSETS = 60  # that are tried together
COVERS = 0.05  # share of the hole that one must cover
KNOWN = 3.0  # weight of that comparison
ALIKE = 30.0  # levels that a difference of normals counts, where patches are compared
LIES = 20.0  # cost of a pixel by the squared difference of normals
STRETCHED, EVEN = 40.0, 0.1  # the same, of how a plane that both lie on is stretched; not counted up to this
DISTANCE, SAME_DISTANCE = 12.0, 0.3  # the same, for each time that it is twice as far away; not counted up to this
UNLIKE = 40.0  # these together at most: what is in the hole is a guess
ELSEWHERE = 15.0  # cost of a pixel of a plane taken from beside that plane
DEAR = 20.0  # what half of the hole must pay less than, or nothing is put together: there is nothing like it
TONE, FINE = 0.2, 6.0  # weight of the difference from the tone around the hole, of what is blurred by so many pixels
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
    """Pixels, [N] rows and columns, of the hole and the ring around it, and which are inside."""

    rows: np.ndarray
    columns: np.ndarray
    inside: np.ndarray

    def of(self, which: np.ndarray) -> _Laid:
        return _Laid(self.rows[which], self.columns[which], self.inside[which])


@dataclass(frozen=True)
class _Seen:
    """The view, `target`; of its own photograph colours, their finer part and the tone, [H, W, 3] each, what may be
    taken, bool [H, W], and what stands before the rest, int [H, W]; smooth planes, int [H, W]; and the tone around the
    hole, [H, W, 3]."""

    target: Shown
    colors: np.ndarray
    fine: np.ndarray
    tone: np.ndarray
    clear: np.ndarray
    layer: np.ndarray
    plane: np.ndarray
    around: np.ndarray

    def taken(self, laid: _Laid, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """[N] rows and columns that an offset takes pixels from, and what that costs: `UNKNOWN` where it may not."""
        (height, width), target = self.clear.shape, self.target
        row, column = laid.rows + offset[0], laid.columns + offset[1]
        there = (row >= 0) & (column >= 0) & (row < height) & (column < width)
        row, column = row.clip(0, height - 1), column.clip(0, width - 1)
        there &= self.clear[row, column] & (self.layer[row, column] == target.layer[laid.rows, laid.columns])
        here, plane = (laid.rows, laid.columns), self.plane[row, column]
        there &= (plane == 0) | (self.plane[here] == 0) | (plane == self.plane[here])
        lies = LIES * ((target.normal[row, column] - target.normal[here]) ** 2).sum(1)
        lies += np.minimum(STRETCHED * np.maximum(_stretched(target, (row, column), here) - EVEN, 0), 2 * LIES)
        farther = np.abs(np.log2(target.size[row, column] / target.size[here]))
        cost = np.minimum(lies + DISTANCE * np.maximum(farther - SAME_DISTANCE, 0), UNLIKE)
        other = (target.surface[here] > 0) & (target.surface[row, column] != target.surface[here])
        cost += ELSEWHERE * other
        cost += TONE * np.abs(self.tone[row, column] - self.around[here]).mean(1)
        return row, column, np.where(there, cost, UNKNOWN)


def shifted(target: Shown, hole: np.ndarray, own: Shown, smooth: Sequence[int] = (), seed: int = 0) -> Moved:
    """The target with its hole, bool [H, W], put together from pieces of its own photograph, `own`; not where no piece
    shows what it should.

    Args:
        target: its image is read outside the hole, and what it says of surfaces everywhere.
        smooth: numbers of the planes that another of them is never taken for.
        seed: of the draw of patches that are compared.
    """
    nothing = Moved(target.image, np.zeros_like(hole), 0.0)
    if not hole.any():
        return nothing
    seen = _seen(target, hole, own, smooth)
    away = ndimage.distance_transform_edt(~hole)
    near = away <= RING
    rows, columns = np.nonzero(near & (hole | ~target.masked))
    laid = _Laid(rows, columns, hole[rows, columns])
    values = np.concatenate([seen.colors, ALIKE * target.normal], -1)
    offsets = _covering(seen, laid, frequent(values, seen.clear, away, np.sqrt(hole.sum()), seed))
    if not offsets or laid.inside.all():
        return nothing
    stride = max(1, int(np.ceil(np.sqrt(len(rows) / MOST))))
    laid = laid.of((rows % stride == 0) & (columns % stride == 0))
    taken, cost = _cut(seen, laid, offsets, stride)
    label = np.full(hole.shape, -1)
    label[laid.rows, laid.columns] = taken
    nearest = ndimage.distance_transform_edt(label < 0, return_distances=False, return_indices=True)
    return Moved(*_drawn(seen, hole, np.where(near, label[tuple(nearest)], -1), offsets), cost)


def _seen(target: Shown, hole: np.ndarray, own: Shown, smooth: Sequence[int]) -> _Seen:
    missing = hole | target.masked
    colors, fine = values_of(target.image, missing)
    tone = _blurred(colors, missing)
    clear = ndimage.binary_erosion(~own.masked & ~missing, iterations=CLEAR) & own.usable
    plane = np.where(np.isin(target.surface, smooth), target.surface, 0)
    return _Seen(target, colors, fine, tone, clear, own.layer, plane, _around(tone, hole, target))


def _covering(seen: _Seen, laid: _Laid, offsets: np.ndarray) -> list[np.ndarray]:
    """Of offsets, [M, 2], the first that cover something of the hole."""
    inside = laid.of(np.flatnonzero(laid.inside))
    inside = inside.of(np.linspace(0, len(inside.rows) - 1, min(len(inside.rows), COMPARED)).astype(int))
    return [each for each in offsets if (seen.taken(inside, each)[2] < UNKNOWN).mean() >= COVERS][:OFFSETS]


def _cut(seen: _Seen, laid: _Laid, offsets: list[np.ndarray], stride: int) -> tuple[np.ndarray, float]:
    """[N], the number of the offset that each pixel takes, one more than there are for none, and what that costs by
    pixel of the hole."""
    shape = seen.clear.shape
    look_at = lambda *at: looks(laid.rows, laid.columns, seen.colors[at], seen.fine[at], shape, stride)
    costs, found = [], []
    for offset in offsets:
        row, column, cost = seen.taken(laid, offset)
        costs.append(cost)
        found.append(look_at(row, column))
    cost, look = np.array(costs), np.array(found)
    off = KNOWN * np.minimum(apart(look, look_at(laid.rows, laid.columns)), 2 * APART)
    cost += np.where(laid.inside | (cost >= UNKNOWN), 0, off)
    pairs = side_by_side(laid.rows, laid.columns, shape, stride)
    taken = expanded(cost, look, pairs)
    first, second = pairs.T
    seams = sum(apart(look[taken[first], at], look[taken[second], at]).sum() for at in (first, second))
    paid = cost[taken, np.arange(len(taken))]
    dear = np.median(paid[laid.inside]) > DEAR
    return np.where((paid < UNKNOWN) & ~dear, taken, len(offsets)), float((paid.sum() + seams) / laid.inside.sum())


def _stretched(target: Shown, there: tuple[np.ndarray, ...], here: tuple[np.ndarray, ...]) -> np.ndarray:
    """[N], how much a step of a pixel along a plane differs between two pixels (rows, columns) on it; 0 off planes,
    much where the plane is seen edge on."""
    found = np.zeros(len(here[0]))
    on = (target.surface[here] > 0) & (target.surface[here] == target.surface[there])
    with np.errstate(invalid="ignore"):
        change = inverse(target.to_plane[there[0][on], there[1][on]]) @ target.to_plane[here[0][on], here[1][on]]
        found[on] = np.linalg.norm(change - np.eye(2), axis=(1, 2))
    return np.where(np.isfinite(found), found, np.inf)


def _drawn(
    seen: _Seen, hole: np.ndarray, label: np.ndarray, offsets: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """The picture and what of its hole is filled, of the number of the offset that each pixel takes, int [H, W]; what
    stands before the rest does not blend with it."""
    window = ndimage.find_objects((label >= 0).astype(int))[0]
    shown = lambda: ((_moved(seen.colors, offset, window), _moved(seen.clear, offset, window)) for offset in offsets)
    image, filled, target = seen.target.image.copy(), np.zeros_like(hole), seen.target
    for k in np.unique(target.layer[hole]):
        mine = target.layer[window] == k
        beside = ~hole[window] & mine & ~target.masked[window]
        image[window], more = assembled(image[window], hole[window] & mine, beside, label[window], shown(), OWN)
        filled[window] |= more
    return image, filled


def _moved(values: np.ndarray, offset: np.ndarray, window: tuple[slice, slice]) -> np.ndarray:
    """[h, w, ...]: at each pixel of a window the value that lies an offset away; zero where that is outside."""
    start = [side.start + int(by) for side, by in zip(window, offset, strict=True)]
    sizes = [side.stop - side.start for side in window]
    found = np.zeros((*sizes, *values.shape[2:]), values.dtype)
    low = [max(0, -at) for at in start]
    high = [min(size, most - at) for size, most, at in zip(sizes, values.shape[:2], start, strict=True)]
    if low[0] < high[0] and low[1] < high[1]:
        to, source = (
            tuple(slice(by + a, by + b) for by, a, b in zip(shift, low, high, strict=True)) for shift in ((0, 0), start)
        )
        found[to] = values[source]
    return found


def _blurred(colors: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """[H, W, 3], the tone: the mean of what is known around."""
    known = (~missing).astype(np.float32)
    blur = lambda a: cv2.GaussianBlur(a, (0, 0), FINE).reshape(*missing.shape, -1)
    return blur(colors * known[..., None]) / np.maximum(blur(known), 1e-3)


def _around(tone: np.ndarray, hole: np.ndarray, target: Shown) -> np.ndarray:
    """[H, W, 3], the tone around the hole, drawn evenly across it; of what stands before the rest by itself."""
    found = tone.copy()
    for k in np.unique(target.layer[hole]):
        mine, beside = hole & (target.layer == k), ~hole & ~target.masked & (target.layer == k)
        if beside.any():
            found[mine] = evenly(tone, mine, beside)
    return found
