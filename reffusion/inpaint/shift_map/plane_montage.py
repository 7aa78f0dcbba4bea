"""A hole in a plane that repeats itself, put together from few large pieces of photographs of the plane.

Each piece is moved by a motion that maps the plane onto itself (after He and Sun 2012, in the plane's own coordinates
and from several photographs), and pieces are cut where they agree. So joints run on straight, and what is round about
the plane's centre stays round.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from reffusion.inpaint.shift_map.expansion import RING, UNKNOWN, apart, assembled, expanded, looks, side_by_side
from reffusion.inpaint.shift_map.plane_motions import (
    APART,
    MOST,
    TOLD,
    Laid,
    Source,
    Way,
    scales,
    shown_at,
    solid,
    source_of,
    taken_from,
    values_at,
    values_of,
    ways_of,
)
from reffusion.inpaint.shift_map.plane_symmetry import Repeats
from reffusion.inpaint.source_image import Shown

BLUR = 12.0  # cost of a pixel for each time that its source shows it at half the size
SHARP = 0.8  # source pixels for one of the hole below which it is blurred
SMALLEST, LARGEST = 0.35, 3.0  # bounds of these, along any direction
OTHER = 6.0  # cost of a pixel from another photograph: its light may be another
TONE = 3e-4  # weight of the pieces' own tone: what a plane shines with is told by what is around the hole


def montage(
    target: Shown, hole: np.ndarray, sources: Sequence[Shown], plane: int, how: Repeats
) -> tuple[np.ndarray, np.ndarray]:
    """The target, uint8 [H, W, 3], with the plane's part of its hole put together, and which pixels are, bool [H, W]:
    not those that no source shows, moved.

    Args:
        hole: bool [H, W]. plane: the number of one that repeats itself as `how` says.
    """
    nothing = target.image, np.zeros_like(hole)
    there = solid(target.surface == plane)
    laid = _laid(target, hole, there)
    seen = [found for source in sources if (found := source_of(source, plane)) is not None]
    if not seen or not laid.inside.any() or (~laid.inside).sum() < TOLD:
        return nothing
    stride = int(np.ceil(np.sqrt(len(laid.rows) / MOST)))
    coarse = laid.of((laid.rows % stride == 0) & (laid.columns % stride == 0))
    ways = ways_of(coarse, seen, how)
    if not ways:
        return nothing
    label = np.full(hole.shape, -1)
    label[coarse.rows, coarse.columns] = _cut(coarse, ways, seen, how, hole.shape, stride)
    nearest = ndimage.distance_transform_edt(label < 0, return_distances=False, return_indices=True)
    label = np.where(there & (label < 0), label[tuple(nearest)], label)
    return _drawn(target, laid, hole, there, label, ways, seen, how)


def _laid(target: Shown, hole: np.ndarray, there: np.ndarray) -> Laid:
    """The hole's pixels on the plane, bool [H, W], and the ring around them."""
    near = ndimage.distance_transform_edt(~(hole & there)) <= RING if (hole & there).any() else hole
    rows, columns = np.nonzero(there & near & (hole | ~target.masked) & (target.place != 0).any(-1))
    values = values_of(target.image, hole | target.masked)
    return Laid(rows, columns, *(each[rows, columns] for each in (target.place, target.to_plane, hole, *values)))


def _cut(
    laid: Laid, ways: Sequence[Way], seen: Sequence[Source], how: Repeats, shape: tuple[int, int], stride: int
) -> np.ndarray:
    """[N], the number of the way that each pixel takes, so that differences along the cuts and from the ring are
    least."""
    costs, seen_so = [], []
    look_of = lambda colors, fine: looks(laid.rows, laid.columns, colors, fine, shape, stride)
    for way in ways:
        at = taken_from(laid, way, seen, how)
        source = seen[way.source]
        fewest, most = scales(laid, at, way, seen, how)
        cost = BLUR * np.maximum(np.log2(SHARP / np.maximum(fewest, 1e-6)), 0) + OTHER * (way.source > 0)
        costs.append(np.where(shown_at(at, source.clear) & (fewest > SMALLEST) & (most < LARGEST), cost, UNKNOWN))
        seen_so.append(look_of(values_at(at, source.colors), values_at(at, source.fine)))
    cost, look = np.array(costs), np.array(seen_so)
    off = np.minimum(apart(look, look_of(laid.colors, laid.fine)), 2 * APART)
    cost += np.where(laid.inside | (cost >= UNKNOWN), 0, off)
    return expanded(cost, look, side_by_side(laid.rows, laid.columns, shape, stride))


def _drawn(
    target: Shown,
    laid: Laid,
    hole: np.ndarray,
    there: np.ndarray,
    label: np.ndarray,
    ways: Sequence[Way],
    seen: Sequence[Source],
    how: Repeats,
) -> tuple[np.ndarray, np.ndarray]:
    """See `montage`: the pieces, blended by their changes."""

    def shown(way: Way) -> tuple[np.ndarray, np.ndarray]:
        at, source = taken_from(laid, way, seen, how), seen[way.source]
        picture, valid = np.zeros(target.image.shape, np.float32), np.zeros_like(hole)
        picture[laid.rows, laid.columns] = values_at(at, source.colors)
        valid[laid.rows, laid.columns] = shown_at(at, source.clear)
        return picture, valid

    return assembled(target.image, hole, ~hole & there & ~target.masked, label, map(shown, ways), TONE)
