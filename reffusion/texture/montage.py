"""A hole in a plane that repeats itself, put together from few large pieces of photographs of the plane.

Each piece is moved by a motion that maps the plane onto itself (after He and Sun 2012, in the plane's own coordinates
and from several photographs), and pieces are cut where they agree (after Kwatra et al. 2003), by expansion moves
(Boykov et al. 2001). So joints run on straight, and what is round about the plane's centre stays round.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from reffusion.cuts import least_cut
from reffusion.texture.blending import blended
from reffusion.texture.pieces import (
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
from reffusion.texture.regular import Repeats
from reffusion.texture.shown import Shown

RING = 6  # px around the hole in which pieces are compared with what is known
COLOR, CHANGE = 0.7, 2.0  # weight of the tone, and of changes from pixel to pixel, beside finer colour
BLUR = 12.0  # cost of a pixel for each time that its source shows it at half the size
SHARP = 0.8  # source pixels for one of the hole below which it is blurred
SMALLEST, LARGEST = 0.35, 3.0  # bounds of these, along any direction
OTHER = 6.0  # cost of a pixel from another photograph: its light may be another
UNKNOWN = 500.0  # cost of a pixel that a way does not show
TONE = 3e-4  # weight of the pieces' own tone: what a plane shines with is told by what is around the hole
ROUNDS = 2  # of expansion over all ways
SCALE = 0.1  # of costs, so that their sum fits whole numbers of 32 bits


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
    costs, looks = [], []
    for way in ways:
        at = taken_from(laid, way, seen, how)
        source = seen[way.source]
        fewest, most = scales(laid, at, way, seen, how)
        cost = BLUR * np.maximum(np.log2(SHARP / np.maximum(fewest, 1e-6)), 0) + OTHER * (way.source > 0)
        costs.append(np.where(shown_at(at, source.clear) & (fewest > SMALLEST) & (most < LARGEST), cost, UNKNOWN))
        looks.append(_looks(laid, values_at(at, source.colors), values_at(at, source.fine), shape, stride))
    cost, look = np.array(costs), np.array(looks)
    known = _looks(laid, laid.colors, laid.fine, shape, stride)
    apart = np.minimum(np.linalg.norm(look - known, axis=-1) / np.sqrt(3), 2 * APART)
    cost += np.where(laid.inside | (cost >= UNKNOWN), 0, apart)
    return _expanded(cost, look, _pairs(laid, shape, stride))


def _looks(laid: Laid, colors: np.ndarray, fine: np.ndarray, shape: tuple[int, int], stride: int) -> np.ndarray:
    """[N, 8] float32, what is compared: colours, their finer part, and its changes to the next pixel."""
    grid = np.zeros(shape, np.float32)
    grey = fine.mean(1)
    grid[laid.rows, laid.columns] = grey
    there = np.zeros(shape, bool)
    there[laid.rows, laid.columns] = True
    changes = []
    for down, along in ((0, stride), (stride, 0)):
        row, column = np.minimum(laid.rows + down, shape[0] - 1), np.minimum(laid.columns + along, shape[1] - 1)
        changes.append(np.where(there[row, column], grid[row, column] - grey, 0))
    return np.concatenate([COLOR * colors, fine, CHANGE * np.stack(changes, 1)], 1).astype(np.float32)


def _pairs(laid: Laid, shape: tuple[int, int], stride: int) -> np.ndarray:
    """[E, 2], numbers of pixels next to each other."""
    index = np.full(shape, -1)
    index[laid.rows, laid.columns] = np.arange(len(laid.rows))
    sides = ((index[:, :-stride], index[:, stride:]), (index[:-stride], index[stride:]))
    pairs = np.concatenate([np.stack([first.ravel(), second.ravel()], 1) for first, second in sides])
    return pairs[(pairs >= 0).all(1)]


def _expanded(cost: np.ndarray, look: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """[N], labels of low total cost: [L, N] each, and between neighbours the difference of what both labels show
    ([L, N, 8]) in both places."""
    first, second = pairs.T

    def seam(one: np.ndarray, two: np.ndarray) -> np.ndarray:
        apart = sum(np.linalg.norm(look[one, at] - look[two, at], axis=1) for at in (first, second))
        return apart / np.sqrt(3)

    pixels = np.arange(cost.shape[1])
    energy = lambda labels: cost[labels, pixels].sum() + seam(labels[first], labels[second]).sum()
    labels = cost.argmin(0)
    least = energy(labels)
    for way in list(range(len(cost))) * ROUNDS:
        stays, first_moves, second_moves = (
            seam(labels[first], labels[second]), seam(np.full(len(first), way), labels[second]),
            seam(labels[first], np.full(len(first), way)),
        )  # fmt: skip
        keep, move = cost[labels, pixels].copy(), cost[way].copy()
        # As in Kolmogorov and Zabih 2004: what a pair costs more than its parts is the cost of a border in it.
        border = np.maximum(first_moves + second_moves - stays, 0) / 2
        np.add.at(move, first, first_moves - stays - border)
        np.add.at(move, second, border - first_moves)
        shared = np.minimum(keep, move)
        moves = least_cut(SCALE * (move - shared), SCALE * (keep - shared), pairs, SCALE * border)
        found = np.where(moves, way, labels)
        if (total := energy(found)) < least:
            labels, least = found, total
    return labels


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
    own = target.image.astype(np.float32)
    shows = np.zeros_like(hole)
    changes, counts = np.zeros((2, *own.shape), np.float32), np.zeros((2, *hole.shape), np.float32)
    sides = ((0, 1), (1, 0))
    for k, way in enumerate(ways):
        at, source = taken_from(laid, way, seen, how), seen[way.source]
        picture, valid = np.zeros_like(own), np.zeros_like(hole)
        picture[laid.rows, laid.columns] = values_at(at, source.colors)
        valid[laid.rows, laid.columns] = shown_at(at, source.clear)
        mine = valid & (label == k)
        own[mine & hole], shows = picture[mine & hole], shows | mine
        for axis, (down, along) in enumerate(sides):
            before = (slice(None, -down or None), slice(None, -along or None))
            after = (slice(down, None), slice(along, None))
            for here in (mine[before], mine[after]):  # each of two neighbours says how the one differs from the other
                both = here & valid[before] & valid[after]
                changes[axis][before][both] += (picture[after] - picture[before])[both]
                counts[axis][before] += both
    filled = hole & shows
    if not filled.any():
        return target.image, filled
    right, below = changes / np.maximum(counts, 1)[..., None]
    beside = ~hole & there & ~target.masked
    image = target.image.copy()
    colors = blended(own, filled, right, below, own, beside, TONE)
    image[filled] = colors.clip(0, 255).round().astype(np.uint8)
    return image, filled
