"""A hole in a plane that repeats itself, put together from few large pieces of photographs of the plane.

Each piece is moved by a motion that maps the plane onto itself (after He and Sun 2012, in the plane's own coordinates
and from several photographs), and pieces are cut where they agree (after Kwatra et al. 2003), by expansion moves
(Boykov et al. 2001). So joints run on straight, and what is round about the plane's centre stays round.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from reffusion.cuts import least_cut
from reffusion.texture.blending import blended
from reffusion.texture.regular import Repeats
from reffusion.texture.shown import Shown

RING = 6  # px around the hole in which pieces are compared with what is known
CLEAR = 2  # px that a piece's source stays away from what is masked
MOST = 15000  # pixels that pieces are laid out for: of a larger hole every second, third ...
PIECES = 48  # ways of moving that are tried together
COVERS = 0.1  # share of the hole that one must cover
TOLD = 60  # pixels of the ring that it must be compared in
COMPARED = 800  # of them at most
AROUND = 25  # px, a side of the window in which ways compete for the ring
STEPS = (1.0, 0.5, 0.25)  # cells by which a way is put right, step by step
TONE = 0.015  # of the image's width: changes over more are tone, which blending evens out
COLOR, CHANGE = 0.7, 2.0  # weight of the tone, and of changes from pixel to pixel, beside finer colour
APART = 60.0  # difference in finer colour above which pixels do not fit at all
BLUR = 12.0  # cost of a pixel for each time that its source shows it at half the size
SHARP = 0.8  # source pixels for one of the hole below which it is blurred
SMALLEST, LARGEST = 0.35, 3.0  # bounds of these, along any direction
OTHER = 6.0  # cost of a pixel from another photograph: its light may be another
UNKNOWN = 500.0  # cost of a pixel that a way does not show
ROUNDS = 2  # of expansion over all ways
SCALE = 0.1  # of costs, so that their sum fits whole numbers of 32 bits


@dataclass(frozen=True)
class Source:
    """A photograph of the plane: [H, W, 3] float32, colours and their finer part; bool [H, W], where it may be read;
    [3, 3], from places on the plane to its pixels (x, y, 1)."""

    colors: np.ndarray
    fine: np.ndarray
    clear: np.ndarray
    across: np.ndarray


@dataclass(frozen=True)
class Way:
    """A way to move a source over the hole: its number, a motion of the plane, and a shift [2] that puts it right."""

    source: int
    motion: np.ndarray
    shift: np.ndarray


@dataclass(frozen=True)
class Laid:
    """Pixels (rows, columns: [N]) to be filled or compared, their places [N, 2], the change of the place by a pixel
    [N, 2, 2], which of them are in the hole, and of the others colours and their finer part, [N, 3] each."""

    rows: np.ndarray
    columns: np.ndarray
    places: np.ndarray
    steps: np.ndarray
    inside: np.ndarray
    colors: np.ndarray
    fine: np.ndarray

    def of(self, which: np.ndarray) -> Laid:
        return Laid(*(each[which] for each in vars(self).values()))


def montage(
    target: Shown, hole: np.ndarray, sources: Sequence[Shown], plane: int, how: Repeats
) -> tuple[np.ndarray, np.ndarray]:
    """The target, uint8 [H, W, 3], with the plane's part of its hole put together, and which pixels are, bool [H, W]:
    not those that no source shows, moved.

    Args:
        hole: bool [H, W]. plane: the number of one that repeats itself as `how` says.
    """
    nothing = target.image, np.zeros_like(hole)
    there = _solid(target.surface == plane)
    laid = _laid(target, hole, there)
    seen = [found for source in sources if (found := _source(source, plane)) is not None]
    if not seen or not laid.inside.any() or (~laid.inside).sum() < TOLD:
        return nothing
    stride = int(np.ceil(np.sqrt(len(laid.rows) / MOST)))
    coarse = laid.of((laid.rows % stride == 0) & (laid.columns % stride == 0))
    ways = _ways(coarse, seen, how)
    if not ways:
        return nothing
    label = np.full(hole.shape, -1)
    label[coarse.rows, coarse.columns] = _cut(coarse, ways, seen, how, hole.shape, stride)
    nearest = ndimage.distance_transform_edt(label < 0, return_distances=False, return_indices=True)
    label = np.where(there & (label < 0), label[tuple(nearest)], label)
    return _drawn(target, hole, there, label, ways, seen, how)


def _solid(mask: np.ndarray) -> np.ndarray:
    return cv2.medianBlur(mask.astype(np.uint8), 5) > 0


def _laid(target: Shown, hole: np.ndarray, there: np.ndarray) -> Laid:
    """The hole's pixels on the plane, bool [H, W], and the ring around them."""
    near = ndimage.distance_transform_edt(~(hole & there)) <= RING if (hole & there).any() else hole
    rows, columns = np.nonzero(there & near & (hole | ~target.masked) & (target.place != 0).any(-1))
    values = _values(target.image, hole | target.masked)
    return Laid(rows, columns, *(each[rows, columns] for each in (target.place, target.to_plane, hole, *values)))


def _values(image: np.ndarray, masked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[H, W, 3] float32: colours, and what differs in them from the mean around."""
    known, colors = (~masked).astype(np.float32)[..., None], image.astype(np.float32)
    blur = lambda a: cv2.GaussianBlur(a, (0, 0), TONE * image.shape[1]).reshape(*a.shape[:2], -1)
    return colors, colors - blur(colors * known) / np.maximum(blur(known), 1e-3)


def _source(shown: Shown, plane: int) -> Source | None:
    """None where the picture hardly shows the plane."""
    clear = ndimage.binary_erosion(~shown.masked, iterations=CLEAR) & shown.usable & _solid(shown.surface == plane)
    rows, columns = np.nonzero(clear & (shown.surface == plane))
    if len(rows) < MOST // 50:
        return None
    some = np.linspace(0, len(rows) - 1, min(len(rows), 1000)).astype(int)
    pixels = np.stack([columns[some], rows[some]], 1).astype(np.float64)
    across, _ = cv2.findHomography(shown.place[rows[some], columns[some]].astype(np.float64), pixels, 0)
    return None if across is None else Source(*_values(shown.image, shown.masked), clear, across)


def _at(laid: Laid, way: Way, seen: Sequence[Source], how: Repeats) -> np.ndarray:
    """[N, 2] float32, where (x, y) in its source a way takes pixels from."""
    places = how.moved(laid.places.astype(np.float64), way.motion) + way.shift
    return cv2.perspectiveTransform(places[None], seen[way.source].across)[0].clip(-1e6, 1e6).astype(np.float32)


def _shown(at: np.ndarray, clear: np.ndarray) -> np.ndarray:
    """bool [N], which pixels [N, 2] of a picture may be read."""
    height, width = clear.shape
    column, row = np.round(at).astype(int).T
    inside = (row >= 1) & (column >= 1) & (row < height - 1) & (column < width - 1)
    inside[inside] = clear[row[inside], column[inside]]
    return inside


def _taken(at: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """A picture's values [N, 3] at pixels [N, 2]."""
    grid = np.full((-(-len(at) // 1024) * 1024, 2), -1, np.float32)  # cv2.remap takes no side above 32767
    grid[: len(at)] = at
    x, y = (np.ascontiguousarray(grid[:, axis]).reshape(-1, 1024) for axis in (0, 1))
    return cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).reshape(-1, 3)[: len(at)]


def _scales(laid: Laid, at: np.ndarray, way: Way, seen: Sequence[Source], how: Repeats) -> tuple[np.ndarray, ...]:
    """[N] each: the fewest and the most source pixels along a pixel of the hole."""
    places = how.moved(laid.places.astype(np.float64), way.motion) + way.shift
    across = seen[way.source].across
    weight = places @ across[2, :2] + across[2, 2]
    slope = (across[None, :2, :2] - at[:, :, None] * across[2, :2]) / weight[:, None, None]
    change = slope @ how.turn(way.motion) @ laid.steps
    area, square = np.abs(np.linalg.det(change)), (change**2).sum((1, 2))
    most = np.sqrt((square + np.sqrt(np.maximum(square**2 - 4 * area**2, 0))) / 2)
    return area / np.maximum(most, 1e-12), most


def _ways(laid: Laid, seen: Sequence[Source], how: Repeats) -> list[Way]:
    """Those that fit what is known around the hole, each somewhere, put right by it."""
    ring, inside = laid.of(~laid.inside), laid.of(laid.inside)
    ring = ring.of(np.linspace(0, len(ring.rows) - 1, min(len(ring.rows), COMPARED)).astype(int))
    inside = inside.of(np.linspace(0, len(inside.rows) - 1, min(len(inside.rows), COMPARED)).astype(int))
    ways = [Way(number, motion, np.zeros(2)) for number in range(len(seen)) for motion in how.motions]
    ways = [way for way in ways if _shown(_at(inside, way, seen, how), seen[way.source].clear).mean() >= COVERS]
    ways = _best(ring, ways, seen, how, 2 * PIECES)
    return _best(ring, [_put_right(ring, way, seen, how) for way in ways], seen, how, PIECES)


def _off(ring: Laid, way: Way, seen: Sequence[Source], how: Repeats) -> tuple[np.ndarray, np.ndarray]:
    """[N], by how much finer colours differ from what is known, and bool [N], where the way shows something."""
    at, source = _at(ring, way, seen, how), seen[way.source]
    return np.minimum(np.linalg.norm(_taken(at, source.fine) - ring.fine, axis=1), APART), _shown(at, source.clear)


def _put_right(ring: Laid, way: Way, seen: Sequence[Source], how: Repeats) -> Way:
    """The way, shifted along the plane and turned a little so that it fits best."""

    def misfit(asked: Way) -> float:
        differs, told = _off(ring, asked, seen, how)
        return float(differs[told].mean()) if told.sum() >= TOLD / 2 else np.inf

    arm = 1.0 if how.centre is None else float(np.median(np.linalg.norm(ring.places - how.centre, axis=1)))
    least = misfit(way)
    for step in STEPS:
        size = step * how.cell
        for _ in range(2):
            tried = [Way(way.source, way.motion, way.shift + size * np.array(to)) for to in _SIDES]
            if how.centre is not None:
                tried += [Way(way.source, way.motion + turn * size / arm, way.shift) for turn in (-1, 1)]
            found = [misfit(each) for each in tried]
            if min(found) < least:
                least, way = min(found), tried[int(np.argmin(found))]
    return way


_SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1))


def _best(ring: Laid, ways: Sequence[Way], seen: Sequence[Source], how: Repeats, most: int) -> list[Way]:
    """Those that together fit what is known around the hole best, each somewhere in it."""
    (top, left), side = (ring.rows.min(), ring.columns.min()), AROUND // 2
    shape = (ring.rows.max() - top + 1, ring.columns.max() - left + 1)
    at = ring.rows - top, ring.columns - left
    blur = lambda a: cv2.blur(a, (2 * side + 1,) * 2, borderType=cv2.BORDER_CONSTANT)[at]
    near = []
    for way in ways:
        differs, told = _off(ring, way, seen, how)
        if told.sum() < TOLD:
            differs[:] = APART
        total, count = np.zeros((2, *shape), np.float32)
        total[at], count[at] = np.where(told, differs, APART), 1
        near.append(blur(total) / np.maximum(blur(count), 1e-6))
    chosen: list[int] = []
    around, least = np.array(near), np.full(len(ring.rows), APART)
    for _ in range(min(most, len(ways))):
        gain = np.maximum(least - around, 0).sum(1) - 1e-3 * around.mean(1)
        gain[chosen] = -np.inf
        chosen.append(int(gain.argmax()))
        least = np.minimum(least, around[chosen[-1]])
    return [ways[k] for k in chosen]


def _cut(
    laid: Laid, ways: Sequence[Way], seen: Sequence[Source], how: Repeats, shape: tuple[int, int], stride: int
) -> np.ndarray:
    """[N], the number of the way that each pixel takes, so that differences along the cuts and from the ring are
    least."""
    costs, looks = [], []
    for way in ways:
        at = _at(laid, way, seen, how)
        source = seen[way.source]
        fewest, most = _scales(laid, at, way, seen, how)
        cost = BLUR * np.maximum(np.log2(SHARP / np.maximum(fewest, 1e-6)), 0) + OTHER * (way.source > 0)
        costs.append(np.where(_shown(at, source.clear) & (fewest > SMALLEST) & (most < LARGEST), cost, UNKNOWN))
        looks.append(_looks(laid, _taken(at, source.colors), _taken(at, source.fine), shape, stride))
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
    hole: np.ndarray,
    there: np.ndarray,
    label: np.ndarray,
    ways: Sequence[Way],
    seen: Sequence[Source],
    how: Repeats,
) -> tuple[np.ndarray, np.ndarray]:
    """See `montage`: the pieces, blended by their changes."""
    own = target.image.astype(np.float32)
    laid = _laid(target, hole, there)
    shows = np.zeros_like(hole)
    changes, counts = np.zeros((2, *own.shape), np.float32), np.zeros((2, *hole.shape), np.float32)
    sides = ((0, 1), (1, 0))
    for k, way in enumerate(ways):
        at, source = _at(laid, way, seen, how), seen[way.source]
        picture, valid = np.zeros_like(own), np.zeros_like(hole)
        picture[laid.rows, laid.columns], valid[laid.rows, laid.columns] = (
            _taken(at, source.colors),
            _shown(at, source.clear),
        )
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
    colors = blended(own, filled, right, below, own, beside)
    image[filled] = colors.clip(0, 255).round().astype(np.uint8)
    return image, filled
