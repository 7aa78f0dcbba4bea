"""Ways to move photographs of a plane over a hole in it, by motions that map the plane onto itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from reffusion.inpaint.shift_map.plane_symmetry import Repeats
from reffusion.inpaint.source_image import Shown

CLEAR = 2  # px that a piece's source stays away from what is masked
MOST = 15000  # pixels that pieces are laid out for: of a larger hole every second, third ...
PIECES = 48  # ways of moving that are tried together
COVERS = 0.1  # share of the hole that one must cover
TOLD = 60  # pixels of the ring that it must be compared in
COMPARED = 800  # of them at most
AROUND = 25  # px, a side of the window in which ways compete for the ring
STEPS = (1.0, 0.5, 0.25)  # cells by which a way is put right, step by step
TONE = 0.015  # of the image's width: changes over more are tone, which blending evens out
APART = 60.0  # difference in finer colour above which pixels do not fit at all
SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1))


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


def solid(mask: np.ndarray) -> np.ndarray:
    """bool [H, W], without specks and without holes of a pixel or two."""
    return cv2.medianBlur(mask.astype(np.uint8), 5) > 0


def values_of(image: np.ndarray, masked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[H, W, 3] float32: colours, and what differs in them from the mean around."""
    known, colors = (~masked).astype(np.float32)[..., None], image.astype(np.float32)
    blur = lambda a: cv2.GaussianBlur(a, (0, 0), TONE * image.shape[1]).reshape(*a.shape[:2], -1)
    return colors, colors - blur(colors * known) / np.maximum(blur(known), 1e-3)


def source_of(shown: Shown, plane: int) -> Source | None:
    """None where the picture hardly shows the plane."""
    clear = ndimage.binary_erosion(~shown.masked, iterations=CLEAR) & shown.usable & solid(shown.surface == plane)
    rows, columns = np.nonzero(clear & (shown.surface == plane))
    if len(rows) < MOST // 50:
        return None
    some = np.linspace(0, len(rows) - 1, min(len(rows), 1000)).astype(int)
    pixels = np.stack([columns[some], rows[some]], 1).astype(np.float64)
    across, _ = cv2.findHomography(shown.place[rows[some], columns[some]].astype(np.float64), pixels, 0)
    return None if across is None else Source(*values_of(shown.image, shown.masked), clear, across)


def _moved(laid: Laid, way: Way, how: Repeats) -> np.ndarray:
    """[N, 2], where on the plane a way takes pixels from."""
    return how.moved(laid.places.astype(np.float64), way.motion) + way.shift


def taken_from(laid: Laid, way: Way, seen: Sequence[Source], how: Repeats) -> np.ndarray:
    """[N, 2] float32, where (x, y) in its source a way takes pixels from."""
    at = cv2.perspectiveTransform(_moved(laid, way, how)[None], seen[way.source].across)[0]
    return at.clip(-1e6, 1e6).astype(np.float32)


def shown_at(at: np.ndarray, clear: np.ndarray) -> np.ndarray:
    """bool [N], which pixels [N, 2] of a picture may be read."""
    height, width = clear.shape
    column, row = np.round(at).astype(int).T
    inside = (row >= 1) & (column >= 1) & (row < height - 1) & (column < width - 1)
    inside[inside] = clear[row[inside], column[inside]]
    return inside


def values_at(at: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """A picture's values [N, 3] at pixels [N, 2]."""
    grid = np.full((-(-len(at) // 1024) * 1024, 2), -1, np.float32)  # cv2.remap takes no side above 32767
    grid[: len(at)] = at
    x, y = (np.ascontiguousarray(grid[:, axis]).reshape(-1, 1024) for axis in (0, 1))
    return cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).reshape(-1, 3)[: len(at)]


def scales(laid: Laid, at: np.ndarray, way: Way, seen: Sequence[Source], how: Repeats) -> tuple[np.ndarray, ...]:
    """[N] each: the fewest and the most source pixels along a pixel of the hole."""
    places, across = _moved(laid, way, how), seen[way.source].across
    weight = places @ across[2, :2] + across[2, 2]
    slope = (across[None, :2, :2] - at[:, :, None] * across[2, :2]) / weight[:, None, None]
    change = slope @ how.turn(way.motion) @ laid.steps
    area, square = np.abs(np.linalg.det(change)), (change**2).sum((1, 2))
    most = np.sqrt((square + np.sqrt(np.maximum(square**2 - 4 * area**2, 0))) / 2)
    return area / np.maximum(most, 1e-12), most


def ways_of(laid: Laid, seen: Sequence[Source], how: Repeats) -> list[Way]:
    """Those that fit what is known around the hole, each somewhere, put right by it."""
    ring, inside = laid.of(~laid.inside), laid.of(laid.inside)
    ring = ring.of(np.linspace(0, len(ring.rows) - 1, min(len(ring.rows), COMPARED)).astype(int))
    inside = inside.of(np.linspace(0, len(inside.rows) - 1, min(len(inside.rows), COMPARED)).astype(int))
    ways = [Way(number, motion, np.zeros(2)) for number in range(len(seen)) for motion in how.motions]
    covered = lambda way: shown_at(taken_from(inside, way, seen, how), seen[way.source].clear).mean()
    ways = [way for way in ways if covered(way) >= COVERS]
    ways = _best(ring, ways, seen, how, 2 * PIECES)
    return _best(ring, [_put_right(ring, way, seen, how) for way in ways], seen, how, PIECES)


def _off(ring: Laid, way: Way, seen: Sequence[Source], how: Repeats) -> tuple[np.ndarray, np.ndarray]:
    """[N], by how much finer colours differ from what is known, and bool [N], where the way shows something."""
    at, source = taken_from(ring, way, seen, how), seen[way.source]
    return np.minimum(np.linalg.norm(values_at(at, source.fine) - ring.fine, axis=1), APART), shown_at(at, source.clear)


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
            tried = [Way(way.source, way.motion, way.shift + size * np.array(to)) for to in SIDES]
            if how.centre is not None:
                tried += [Way(way.source, way.motion + turn * size / arm, way.shift) for turn in (-1, 1)]
            found = [misfit(each) for each in tried]
            if min(found) < least:
                least, way = min(found), tried[int(np.argmin(found))]
    return way


def _best(ring: Laid, ways: Sequence[Way], seen: Sequence[Source], how: Repeats, most: int) -> list[Way]:
    """Those that together fit what is known around the hole best, each somewhere in it."""
    top, left = ring.rows.min(), ring.columns.min()
    shape = (ring.rows.max() - top + 1, ring.columns.max() - left + 1)
    at = ring.rows - top, ring.columns - left
    blur = lambda a: cv2.blur(a, (AROUND, AROUND), borderType=cv2.BORDER_CONSTANT)[at]
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
