"""Motions along a plane that map what it shows onto itself: planks onto planks, tiles onto tiles.

Offsets between like patches of a picture crowd at a few values (after He and Sun 2012); on a plane they are taken in
its own metric coordinates, so that they hold in every picture of it. Where the lines of a plane meet in a point, as the
joints of a round table do, they are turns about that point, and offsets away from it. A hole is best filled by patches
moved so.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from reffusion import seeding

SIDE = 224  # cells at most a side of a plane's map
PATCH = 8  # cells a side of what is compared
COMPONENTS = 16  # of its principal ones
ASKED = 4000  # patches for which like ones are looked for
LIKE = 40  # nearest in looks, of which the first that lies far enough away counts
AWAY = 0.06  # of the map's side, at least: nearer everything is like itself
TILE = 16  # cells a side: like patches in one tile, which overlap, count once for an offset
BINS = 96  # cells from the middle of the table of offsets to its border
SHARP, EVEN = 2.0, 9.0  # cells, widths over which offsets are counted, and over which chance would even them out
CHANCE, SURE = 5.0, 12.0  # standard deviations above chance up to which an offset is none, and from which it is regular
LONE = 0.02  # offsets a bin that chance brings at least
FEWEST = 400  # cells with a whole patch, without which nothing can be said
PEAKS = 60  # offsets that are tried
KNOWN = 7.0  # standard deviations above chance from which they are
GAP = 9  # px: narrower gaps in what is shown of a plane, where its depth is uneven, close
LINES, PAIRS = 3000, 400  # steepest cells that tell of lines, and pairs of them that tell where lines meet
STRAIGHT = 0.035  # sine of the angle by which a line may miss that point
MEETING = 1.25  # times as many lines that must go through a point as in one direction
NEAR = 3.0  # map sides from the map's middle within which they meet
SEED = 0  # of what is drawn


class Regular(NamedTuple):
    """What is known of S planes, the first of which, number 0, stands for none.

    Attributes:
        table: [S, 2 BINS + 1, 2 BINS + 1] float32 in [0, 1], how regular an offset is; its middle is no offset.
        pitch: [S, 2] float32, a bin's sides; 0 where nothing is known.
        peaks: [P, 2] float32, the most regular offsets of all planes. starts: [S + 1] int64, where each one's begin.
        turning: [S] bool. centre: [S, 2] float32: offsets are (along x, along y) in the plane's unit, or, turning,
            (away from the centre in it, about it in radians).
    """

    table: np.ndarray
    pitch: np.ndarray
    peaks: np.ndarray
    starts: np.ndarray
    turning: np.ndarray
    centre: np.ndarray


class Seen(NamedTuple):
    """What a picture shows of a plane: pixels [M, 2] (x, y), their places [M, 2] on the plane, the picture."""

    pixels: np.ndarray
    places: np.ndarray
    image: np.ndarray


class Map(NamedTuple):
    """A plane as a picture shows it: [h, w, 3] float32, what is known of it, bool [h, w], and the sides of a cell."""

    values: np.ndarray
    known: np.ndarray
    pitch: np.ndarray


def nothing(planes: int) -> Regular:
    """Of planes numbered up to `planes`, that nothing is known."""
    count, side = planes + 1, 2 * BINS + 1
    table, pitch, centre = (np.zeros((count, *shape), np.float32) for shape in ((side, side), (2,), (2,)))
    return Regular(table, pitch, np.zeros((0, 2), np.float32), np.zeros(count + 1, int), np.zeros(count, bool), centre)


def regular(planes: int, seen: Mapping[int, Seen]) -> Regular:
    """The regular offsets of those planes, of numbers up to `planes`, of which a picture is given."""
    found, peaks = nothing(planes), [np.zeros((0, 2), np.float32)] * (planes + 1)
    for number, picture in seen.items():
        draws = np.random.default_rng(seeding.seed_for(SEED, "regular", str(number)))
        low, high = picture.places.min(0), picture.places.max(0)
        flat = _map(picture, low, high)
        if flat is None:
            continue
        centre = _centre(flat, draws)
        if centre is not None:
            found.turning[number], found.centre[number] = True, low + centre * flat.pitch
            flat = _unrolled(picture, found.centre[number])
        if flat is not None:
            above = _offsets(flat, draws)
            found.table[number], found.pitch[number] = ((above - CHANCE) / (SURE - CHANCE)).clip(0, 1), flat.pitch
            peaks[number] = _peaks(above) * flat.pitch
    starts = np.cumsum([0] + [len(each) for each in peaks])
    return found._replace(peaks=np.concatenate(peaks).astype(np.float32), starts=starts)


def _map(seen: Seen, low: np.ndarray, high: np.ndarray) -> Map | None:
    """Between two corners, along the plane's axes; None where it is no plane to the picture."""
    pitch = np.full(2, _pitch(seen, float((high - low).max())))
    steps = [low[axis] + pitch[axis] * np.arange(int((high - low)[axis] / pitch[axis]) + 1) for axis in (0, 1)]
    return _drawn(seen, np.stack(np.meshgrid(*steps), -1), pitch)


def _pitch(seen: Seen, length: float) -> float:
    """Side of a cell of a map of a length: no finer than the picture's pixels on the whole."""
    area = cv2.contourArea(cv2.convexHull(seen.places.astype(np.float32)))
    return max(length / SIDE, (area / len(seen.places)) ** 0.5, 1e-9)


def _unrolled(seen: Seen, centre: np.ndarray) -> Map | None:
    """A column a distance from the centre, a row a direction, as wide in the middle as it is long."""
    away = seen.places - centre
    distance = np.hypot(*away.T)
    direction = np.angle(np.exp(1j * np.arctan2(away[:, 1], away[:, 0])).mean())  # the seam lies opposite
    angle = np.angle(np.exp(1j * (np.arctan2(away[:, 1], away[:, 0]) - direction)))
    length = max(float(np.ptp(distance)), float(np.median(distance)) * float(np.ptp(angle)) / 2)
    step = _pitch(seen, length)
    pitch = np.array([step, step / float(np.median(distance))])
    radii = np.arange(distance.min(), distance.max(), pitch[0])
    turns = direction + np.arange(angle.min(), angle.max(), pitch[1])
    radius, turn = np.meshgrid(radii, turns)
    return _drawn(seen, centre + radius[..., None] * np.stack([np.cos(turn), np.sin(turn)], -1), pitch)


def _drawn(seen: Seen, places: np.ndarray, pitch: np.ndarray) -> Map | None:
    """What the picture shows at places [h, w, 2]."""
    some = np.linspace(0, len(seen.places) - 1, min(len(seen.places), 2000)).astype(int)
    across, _ = cv2.findHomography(seen.places[some].astype(np.float64), seen.pixels[some].astype(np.float64), 0)
    if across is None or min(places.shape[:2]) < 2 * PATCH:
        return None
    at = cv2.perspectiveTransform(places.reshape(1, -1, 2), across).reshape(places.shape).astype(np.float32)
    shown = np.zeros(seen.image.shape[:2], np.uint8)
    shown[seen.pixels[:, 1], seen.pixels[:, 0]] = 1
    shown = cv2.morphologyEx(shown, cv2.MORPH_CLOSE, np.ones((GAP, GAP)))
    values = cv2.remap(seen.image, at[..., 0], at[..., 1], cv2.INTER_LINEAR).astype(np.float32)
    return Map(values, cv2.remap(shown, at[..., 0], at[..., 1], cv2.INTER_NEAREST) > 0, pitch)


def _centre(flat: Map, draws: np.random.Generator) -> np.ndarray | None:
    """[2], the cell (x, y), perhaps outside the map, in which the lines meet; None where they are rather parallel."""
    grey = cv2.GaussianBlur(flat.values.mean(2), (0, 0), 1.0)
    slope = np.stack([cv2.Scharr(grey, cv2.CV_32F, *way) for way in ((1, 0), (0, 1))], -1)
    length = np.linalg.norm(slope, axis=-1) * (
        cv2.erode(flat.known.astype(np.uint8), np.ones((7, 7)), borderValue=0) > 0
    )
    steepest = np.argsort(-length, axis=None, kind="stable")[:LINES]
    steepest = steepest[length.reshape(-1)[steepest] > 0]
    if len(steepest) < FEWEST:
        return None
    rows, columns = np.unravel_index(steepest, length.shape)
    at = np.stack([columns, rows], 1).astype(np.float64)
    across = slope[rows, columns] / length[rows, columns, None]
    first, second = draws.integers(len(at), size=(2, PAIRS))
    crossing = np.linalg.det(np.stack([across[first], across[second]], 1))
    apart = np.abs(crossing) > STRAIGHT
    heights = (across * at).sum(1)
    a, b, p, q = across[first][apart], across[second][apart], heights[first][apart], heights[second][apart]
    points = np.stack([p * b[:, 1] - q * a[:, 1], a[:, 0] * q - b[:, 0] * p], 1) / crossing[apart, None]
    middle = np.array(grey.shape[::-1]) / 2
    points = points[np.linalg.norm(points - middle, axis=1) < NEAR * SIDE]
    if not len(points):
        return None
    through = [_through(point, at, across) for point in points]
    parallel = max(int((np.abs(across @ (-each[1], each[0])) < STRAIGHT).sum()) for each in across[first])
    best = points[int(np.argmax([mine.sum() for mine in through]))]
    for _ in range(5):
        mine = _through(best, at, across)
        weight = 1 / np.maximum(np.linalg.norm(at[mine] - best, axis=1), PATCH)[:, None]
        best = np.linalg.lstsq(across[mine] * weight, heights[mine, None] * weight, rcond=None)[0][:, 0]
    return best if _through(best, at, across).sum() > MEETING * parallel else None


def _through(point: np.ndarray, at: np.ndarray, across: np.ndarray) -> np.ndarray:
    """bool [L]: lines at [L, 2], normal to `across` [L, 2], that go through the point."""
    away = point - at
    return np.abs((across * away).sum(1)) < STRAIGHT * np.linalg.norm(away, axis=1)


def _offsets(flat: Map, draws: np.random.Generator) -> np.ndarray:
    """[2 BINS + 1, 2 BINS + 1], by how many standard deviations a map's offsets are more than chance brings."""
    table = np.zeros((2 * BINS + 1,) * 2, np.float32)
    whole = cv2.erode(flat.known.astype(np.uint8), np.ones((PATCH, PATCH)), anchor=(0, 0), borderValue=0) > 0
    rows, columns = np.nonzero(whole[: 1 - PATCH, : 1 - PATCH])
    if len(rows) < FEWEST:
        return table
    patches = np.lib.stride_tricks.sliding_window_view(flat.values, (PATCH, PATCH), (0, 1))
    looks = _reduced(patches[rows, columns].reshape(len(rows), -1))
    asked = draws.permutation(len(rows))[:ASKED]
    _, near = cKDTree(looks).query(looks[asked], min(LIKE, len(rows)), eps=1.0)
    places = np.stack([columns, rows], 1)
    offsets = places[near] - places[asked][:, None]
    far = np.abs(offsets).max(-1) > max(PATCH, AWAY * max(whole.shape))
    first = offsets[np.arange(len(asked)), far.argmax(1)]
    counted = np.unique(np.concatenate([first, places[asked] // TILE], 1)[far.any(1)], axis=0)[:, :2]
    inside = counted[(np.abs(counted) <= BINS).all(1)]
    np.add.at(table, (inside[:, 1] + BINS, inside[:, 0] + BINS), 1)
    sharp, even = (ndimage.gaussian_filter(table + table[::-1, ::-1], sigma) for sigma in (SHARP, EVEN))
    deviation = np.sqrt(np.maximum(even, LONE) / (2 * np.pi * SHARP**2))  # of counts by chance, each of them twice
    return (sharp - even) / deviation


def _reduced(patches: np.ndarray) -> np.ndarray:
    """[N, COMPONENTS] float32 of patches [N, D]."""
    centred = patches - patches.mean(0)
    _, vectors = np.linalg.eigh(centred.T @ centred)
    return np.ascontiguousarray((centred @ vectors[:, -COMPONENTS:]).astype(np.float32))


def _peaks(above: np.ndarray) -> np.ndarray:
    """[P, 2], the offsets (x, y), in bins, that are more frequent than their neighbours, at most PEAKS."""
    rows, columns = np.nonzero((above == ndimage.maximum_filter(above, 5)) & (above > KNOWN))
    order = np.argsort(-above[rows, columns], kind="stable")[:PEAKS]
    return np.stack([columns[order] - BINS, rows[order] - BINS], 1).astype(np.float32)
