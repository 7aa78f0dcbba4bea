"""Motions along a plane that map what it shows onto itself: planks onto planks, tiles onto tiles.

What is seen of the plane is drawn in the plane's own metric coordinates and compared with itself, moved: the motions by
which it looks most like itself repeat it, in every picture of it. Where the lines of a plane meet in a point, as the
joints of a round table do, it is turned about that point instead of shifted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from reffusion import seeding

SIDE = 224  # cells at most a side of a plane's map
FEWEST = 400  # cells that must be seen of the plane for anything to be said
BOTH = 0.1  # of the cells seen, and as many at least, that must be seen of it moved, too
EVEN = 6.0  # cells: what changes over more is shading, and is not compared
AWAY = 3  # cells, at least: nearer everything is like itself
ALIKE = 0.6  # correlation of the motion by which a plane looks most like itself; stone reaches 0.5, planks 0.7
OF_BEST = 0.5  # of the highest correlation, which the others must reach
FIRST = 0.75  # of it, from which the smallest turn is the one that the others are multiples of
ASIDE = 0.2  # of that turn, by which a multiple may lie beside where it is expected
MOST = 60  # motions
DISTINCT = 9  # cells a side of a window in which one shift stands for all
SEVERAL = 4  # shifts that a plane must have: both ways, and twice as far, say
GAP = 9  # px: narrower gaps in what is shown of a plane, where its depth is uneven, close
LINES, PAIRS = 3000, 400  # steepest cells that tell of lines, and pairs of them that tell where lines meet
STRAIGHT = 0.035  # sine of the angle by which a line may miss that point
MEETING = 1.25  # times as many lines that must go through a point as in one direction
NEAR = 3.0  # map sides from the map's middle within which they meet
LEAST = 16  # cells a side of a map
REACH = 8.0  # cells to each side of it within which that point is looked for
STEPS, LEAST_GAIN = (2.0, 1.0, 0.5), 1e-3  # cells by which it is put right, while likeness grows so much
SEED = 0  # of what is drawn


@dataclass(frozen=True)
class Repeats:
    """How a plane repeats itself.

    Attributes:
        centre: [2], the place about which it is turned; None: it is shifted.
        motions: [M, 2], shifts in the plane's unit; or [M, 1], turns in radians.
        cell: length to which they are known, in the plane's unit, at most of what is seen of it.
    """

    centre: np.ndarray | None
    motions: np.ndarray
    cell: float

    def moved(self, places: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """Places [N, 2] on the plane, moved."""
        if self.centre is None:
            return places + motion
        cosine, sine = np.cos(motion[0]), np.sin(motion[0])
        return (places - self.centre) @ np.array([[cosine, sine], [-sine, cosine]]) + self.centre

    def turn(self, motion: np.ndarray) -> np.ndarray:
        """[2, 2], by which a motion turns a step on the plane."""
        angle = 0.0 if self.centre is None else motion[0]
        return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


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


def repeats(seen: Seen) -> Repeats | None:
    """How the plane repeats itself, after what a picture shows of it; None: it does not."""
    low, high = seen.places.min(0), seen.places.max(0)
    flat = _map(seen, low, high)
    if flat is None:
        return None
    found = _centre(flat, np.random.default_rng(seeding.seed_for(SEED, "lines")))
    if found is None:
        motions = _shifts(_likeness(flat)) * flat.pitch
        return Repeats(None, motions, flat.pitch[0]) if len(motions) else None
    centre, unrolled = _put_right(seen, low + found * flat.pitch, flat.pitch[0])
    if unrolled is None:
        return None
    motions = _turns(_likeness(unrolled)[:, 0], 2 * np.pi / unrolled.pitch[1]) * unrolled.pitch[1]
    return Repeats(centre, motions[:, None], unrolled.pitch[0]) if len(motions) else None


def _put_right(seen: Seen, centre: np.ndarray, cell: float) -> tuple[np.ndarray, Map | None]:
    """The centre about which what is seen looks like itself at every turn, near one that lines tell; and the map
    unrolled about it. About a wrong one it may look like itself once: a short arc fits many circles. Where no two turns
    are seen, that of the lines stays."""

    def judged(at: np.ndarray) -> tuple[float, Map | None]:
        flat = _unrolled(seen, at)
        return (-1.0 if flat is None else _steady(_likeness(flat)[:, 0], 2 * np.pi / flat.pitch[1]), flat)

    coarse = np.arange(-REACH, REACH + 1, STEPS[0])
    starts = [centre + cell * np.array([x, y]) for y in coarse for x in coarse]
    likely = [judged(start)[0] for start in starts]
    if max(likely) > 0:
        centre = starts[int(np.argmax(likely))]
    best, flat = judged(centre)
    for step in STEPS[1:]:
        for side in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            while (found := judged(centre + step * cell * np.array(side)))[0] > best + LEAST_GAIN:
                (best, flat), centre = found, centre + step * cell * np.array(side)
    return centre, flat


def _steady(likeness: np.ndarray, whole: float) -> float:
    """Mean likeness, [h] by turn, over all turns that repeat a map and of which enough is seen; 0 for fewer than 2."""
    turns = _turns(likeness, whole)
    told = np.interp(turns[turns > 0], np.arange(len(likeness)), likeness)
    told = told[told != 0]
    return float(told.mean()) if len(told) > 1 else 0.0


def _likeness(flat: Map) -> np.ndarray:
    """[h, w], correlation of a map with itself, moved by a row and a column (negative ones from the end); 0 where too
    little of both is known."""
    known = cv2.erode(flat.known.astype(np.uint8), np.ones((5, 5)), borderValue=0) > 0
    grey = flat.values.mean(2)
    fine = np.where(known, grey - cv2.GaussianBlur(grey, (0, 0), EVEN), 0.0).astype(np.float64)
    size = [cv2.getOptimalDFTSize(2 * side) for side in fine.shape]
    picture, mask, power = (np.fft.rfft2(each, size) for each in (fine, known.astype(float), fine**2))
    back = lambda spectrum: np.fft.irfft2(spectrum, size)
    both = np.sqrt(np.maximum(back(power * mask.conj()) * back(power.conj() * mask), 1e-6))
    return np.where(back(np.abs(mask) ** 2) > max(FEWEST, BOTH * known.sum()), back(np.abs(picture) ** 2) / both, 0.0)


def _shifts(likeness: np.ndarray) -> np.ndarray:
    """[M, 2], the shifts (x, y) in cells by which a map looks most like itself, the best first."""
    height, width = (side // 2 for side in likeness.shape)
    near = np.fft.fftshift(likeness)
    peak = (near == ndimage.maximum_filter(near, DISTINCT)) & (near > OF_BEST * ALIKE)
    peak[height - AWAY : height + AWAY + 1, width - AWAY : width + AWAY + 1] = False
    rows, columns = np.nonzero(peak)
    order = np.argsort(-near[rows, columns], kind="stable")[:MOST]
    if len(order) < SEVERAL or near[rows, columns].max() < ALIKE:
        return np.zeros((0, 2))
    return np.stack([columns[order] - width, rows[order] - height], 1).astype(np.float64)


def _turns(likeness: np.ndarray, whole: float) -> np.ndarray:
    """[M], the turns in rows by which a map of directions looks like itself: multiples, either way, of the smallest
    that is about as good as any.

    Args:
        likeness: [h], by turn. whole: rows of a whole turn.
    """
    some = likeness[: min(len(likeness) // 2, int(whole / 2) + 1)]
    rows = np.arange(AWAY, len(some) - 1)
    rows = rows[(some[rows] > some[rows - 1]) & (some[rows] >= some[rows + 1]) & (some[rows] > OF_BEST * ALIKE)]
    if not len(rows) or some[rows].max() < ALIKE:
        return np.zeros(0)
    before, at, after = (some[rows + step] for step in (-1, 0, 1))
    exact = rows + 0.5 * (before - after) / (before - 2 * at + after)
    first = exact[some[rows] > FIRST * some[rows].max()].min()
    found = []
    for k in range(1, int(whole / 2 / first) + 1):
        beside = np.abs(exact - k * first)
        found.append(exact[beside.argmin()] if beside.min() < ASIDE * first else k * first)
    return np.array([way * turn for turn in found[: MOST // 2] for way in (1, -1)])


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
    if across is None or min(places.shape[:2]) < LEAST:
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
        weight = 1 / np.maximum(np.linalg.norm(at[mine] - best, axis=1), LEAST / 2)[:, None]
        best = np.linalg.lstsq(across[mine] * weight, heights[mine, None] * weight, rcond=None)[0][:, 0]
    return best if _through(best, at, across).sum() > MEETING * parallel else None


def _through(point: np.ndarray, at: np.ndarray, across: np.ndarray) -> np.ndarray:
    """bool [L]: lines at [L, 2], normal to `across` [L, 2], that go through the point."""
    away = point - at
    return np.abs((across * away).sum(1)) < STRAIGHT * np.linalg.norm(away, axis=1)
