"""Finds how a plane's texture repeats itself: the motions along it that map planks onto planks, tiles onto tiles.

The plane is resampled from a photograph in its own metric coordinates and correlated with itself. Where correlation
peaks, a shift maps the texture onto itself, in every photograph. Where the texture's lines meet in a point, as the
joints of a round table do, the motions are turns about that point instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from reffusion import seeding

SIDE = 224  # cells, the longest side of a plane's map
MIN_SIDE = 16  # cells, the shortest
MIN_CELLS = 400  # cells of the plane that must be seen
MIN_OVERLAP = 0.1  # of the cells seen: as many must overlap after a shift, and at least `MIN_CELLS`
SHADING_SIGMA = 6.0  # cells: what changes over more is shading, and is not compared
MIN_SHIFT = 3  # cells: nearer every texture is like itself
MIN_CORRELATION = 0.6  # of the best motion; stone reaches 0.5, planks 0.7
MIN_OF_BEST = 0.5  # share of `MIN_CORRELATION` that the other motions must reach
MIN_OF_PEAK = 0.75  # share of the highest peak from which the smallest turn counts as the one that generates the others
TURN_TOLERANCE = 0.2  # of that turn, by which a multiple may miss its expected place
MAX_MOTIONS = 60
PEAK_WINDOW = 9  # cells, a side of the window that has one peak
MIN_SHIFTS = 4  # that a plane must have: both ways, and twice as far, say
CLOSE_PX = 9  # px: narrower gaps in the pixels of a plane are closed, where its depth is uneven
MAX_EDGES, LINE_PAIRS = 3000, 400  # steepest cells, whose edges are taken as lines, and pairs of them that are crossed
SIN_TOLERANCE = 0.035  # sine of the angle by which a line may miss the centre
MIN_CONVERGENCE = 1.25  # times as many lines must meet in the centre as run in one direction
MAX_CENTRE_DISTANCE = 3.0  # map sides from the map's middle within which the centre is sought
CENTRE_REACH = 8.0  # cells to each side of the lines' centre within which it is refined
CENTRE_STEPS, MIN_GAIN = (2.0, 1.0, 0.5), 1e-3  # cells, steps of that, and the gain in correlation that continues it
CENTRE_ITERATIONS = 5  # of the least squares fit of the centre to its lines
HOMOGRAPHY_PIXELS = 2000  # that the homography is fitted to
SEED = 0  # of the random pairs of lines


@dataclass(frozen=True)
class PlaneSymmetry:
    """How a plane's texture repeats itself.

    Attributes:
        centre: [2], the point on the plane about which it turns; None: it shifts.
        motions: [M, 2], shifts in the plane's unit; or [M, 1], turns in radians.
        resolution: to which the motions are known, in the plane's unit; of a turn, at most, at the points seen.
    """

    centre: np.ndarray | None
    motions: np.ndarray
    resolution: float

    def move(self, points: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """Points [N, 2] on the plane, moved by a shift [2] or a turn [1]."""
        if self.centre is None:
            return points + motion
        cosine, sine = np.cos(motion[0]), np.sin(motion[0])
        return (points - self.centre) @ np.array([[cosine, sine], [-sine, cosine]]) + self.centre

    def rotation(self, motion: np.ndarray) -> np.ndarray:
        """[2, 2], the derivative of `move`: the motion's rotation, the identity for a shift."""
        angle = 0.0 if self.centre is None else motion[0]
        return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


class PlanePixels(NamedTuple):
    """What an image shows of a plane: pixels [M, 2] (x, y), their coordinates [M, 2] on the plane, and the image."""

    pixels: np.ndarray
    coordinates: np.ndarray
    image: np.ndarray


class PlaneMap(NamedTuple):
    """A plane's texture on a grid: values [h, w, 3] float32, where they are known, bool [h, w], and the two sides of a
    cell, in the plane's unit (or radians, see `_polar_map`)."""

    values: np.ndarray
    known: np.ndarray
    pitch: np.ndarray


def find_symmetry(seen: PlanePixels) -> PlaneSymmetry | None:
    """How the plane's texture repeats itself, from what an image shows of it; None: it does not."""
    low, high = seen.coordinates.min(0), seen.coordinates.max(0)
    plane_map = _cartesian_map(seen, low, high)
    if plane_map is None:
        return None
    cell = _find_centre(plane_map, np.random.default_rng(seeding.seed_for(SEED, "lines")))
    if cell is None:
        motions = _find_shifts(_autocorrelation(plane_map)) * plane_map.pitch
        return PlaneSymmetry(None, motions, plane_map.pitch[0]) if len(motions) else None
    centre, polar = _refine_centre(seen, low + cell * plane_map.pitch, plane_map.pitch[0])
    if polar is None:
        return None
    motions = _find_turns(_autocorrelation(polar)[:, 0], 2 * np.pi / polar.pitch[1]) * polar.pitch[1]
    return PlaneSymmetry(centre, motions[:, None], polar.pitch[0]) if len(motions) else None


def _refine_centre(seen: PlanePixels, centre: np.ndarray, cell: float) -> tuple[np.ndarray, PlaneMap | None]:
    """The centre [2], near a first estimate, about which the texture is like itself at every turn; and the polar map
    about it.

    About a wrong centre the texture may look like itself once: a short arc fits many circles. Where fewer than two
    turns are seen, the estimate stays.
    """

    def judge(at: np.ndarray) -> tuple[float, PlaneMap | None]:
        polar = _polar_map(seen, at)
        return (
            -1.0 if polar is None else _mean_correlation(_autocorrelation(polar)[:, 0], 2 * np.pi / polar.pitch[1]),
            polar,
        )

    coarse = np.arange(-CENTRE_REACH, CENTRE_REACH + 1, CENTRE_STEPS[0])
    starts = [centre + cell * np.array([x, y]) for y in coarse for x in coarse]
    scores = [judge(start)[0] for start in starts]
    if max(scores) > 0:
        centre = starts[int(np.argmax(scores))]
    best, polar = judge(centre)
    for step in CENTRE_STEPS[1:]:
        for side in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            while (score := judge(centre + step * cell * np.array(side)))[0] > best + MIN_GAIN:
                (best, polar), centre = score, centre + step * cell * np.array(side)
    return centre, polar


def _mean_correlation(correlation: np.ndarray, full_turn: float) -> float:
    """Mean of a correlation, [h] by turn, over all turns that map the texture onto itself and of which enough is seen;
    0 for fewer than 2. `full_turn`: in rows."""
    turns = _find_turns(correlation, full_turn)
    values = np.interp(turns[turns > 0], np.arange(len(correlation)), correlation)
    values = values[values != 0]
    return float(values.mean()) if len(values) > 1 else 0.0


def _autocorrelation(plane_map: PlaneMap) -> np.ndarray:
    """[h, w], normalised correlation of a map with itself, moved by a row and a column (negative ones from the end);
    0 where too little overlaps."""
    known = cv2.erode(plane_map.known.astype(np.uint8), np.ones((5, 5)), borderValue=0) > 0
    grey = plane_map.values.mean(2)
    detail = np.where(known, grey - cv2.GaussianBlur(grey, (0, 0), SHADING_SIGMA), 0.0).astype(np.float64)
    size = [cv2.getOptimalDFTSize(2 * side) for side in detail.shape]
    picture, mask, power = (np.fft.rfft2(each, size) for each in (detail, known.astype(float), detail**2))
    back = lambda spectrum: np.fft.irfft2(spectrum, size)
    both = np.sqrt(np.maximum(back(power * mask.conj()) * back(power.conj() * mask), 1e-6))
    enough = back(np.abs(mask) ** 2) > max(MIN_CELLS, MIN_OVERLAP * known.sum())
    return np.where(enough, back(np.abs(picture) ** 2) / both, 0.0)


def _find_shifts(correlation: np.ndarray) -> np.ndarray:
    """[M, 2], the shifts (x, y) in cells at which an autocorrelation [h, w] peaks, the highest first."""
    height, width = (side // 2 for side in correlation.shape)
    centred = np.fft.fftshift(correlation)
    peak = (centred == ndimage.maximum_filter(centred, PEAK_WINDOW)) & (centred > MIN_OF_BEST * MIN_CORRELATION)
    peak[height - MIN_SHIFT : height + MIN_SHIFT + 1, width - MIN_SHIFT : width + MIN_SHIFT + 1] = False
    rows, columns = np.nonzero(peak)
    order = np.argsort(-centred[rows, columns], kind="stable")[:MAX_MOTIONS]
    if len(order) < MIN_SHIFTS or centred[rows, columns].max() < MIN_CORRELATION:
        return np.zeros((0, 2))
    return np.stack([columns[order] - width, rows[order] - height], 1).astype(np.float64)


def _find_turns(correlation: np.ndarray, full_turn: float) -> np.ndarray:
    """[M], the turns, in rows, that map the texture onto itself: multiples, either way, of the smallest one that is
    about as good as any.

    Args:
        correlation: [h], of a polar map with itself, by turn in rows.
        full_turn: in rows.
    """
    half = correlation[: min(len(correlation) // 2, int(full_turn / 2) + 1)]
    rows = np.arange(MIN_SHIFT, len(half) - 1)
    peak = (half[rows] > half[rows - 1]) & (half[rows] >= half[rows + 1]) & (half[rows] > MIN_OF_BEST * MIN_CORRELATION)
    rows = rows[peak]
    if not len(rows) or half[rows].max() < MIN_CORRELATION:
        return np.zeros(0)
    before, at, after = (half[rows + step] for step in (-1, 0, 1))
    exact = rows + 0.5 * (before - after) / (before - 2 * at + after)
    first = exact[half[rows] > MIN_OF_PEAK * half[rows].max()].min()
    turns = []
    for k in range(1, int(full_turn / 2 / first) + 1):
        off = np.abs(exact - k * first)
        turns.append(exact[off.argmin()] if off.min() < TURN_TOLERANCE * first else k * first)
    return np.array([way * turn for turn in turns[: MAX_MOTIONS // 2] for way in (1, -1)])


def _cartesian_map(seen: PlanePixels, low: np.ndarray, high: np.ndarray) -> PlaneMap | None:
    """The map between two corners [2], along the plane's axes; None as in `_resample`."""
    pitch = np.full(2, _cell_side(seen, float((high - low).max())))
    steps = [low[axis] + pitch[axis] * np.arange(int((high - low)[axis] / pitch[axis]) + 1) for axis in (0, 1)]
    return _resample(seen, np.stack(np.meshgrid(*steps), -1), pitch)


def _cell_side(seen: PlanePixels, length: float) -> float:
    """Side of a cell of a map of this length: on the whole no finer than the image's pixels."""
    area = cv2.contourArea(cv2.convexHull(seen.coordinates.astype(np.float32)))
    return max(length / SIDE, (area / len(seen.coordinates)) ** 0.5, 1e-9)


def _polar_map(seen: PlanePixels, centre: np.ndarray) -> PlaneMap | None:
    """The map about a centre: a column for each radius, a row for each angle (its pitch is in radians). At the median
    radius cells are square. None as in `_resample`."""
    away = seen.coordinates - centre
    distance = np.hypot(*away.T)
    direction = np.angle(np.exp(1j * np.arctan2(away[:, 1], away[:, 0])).mean())  # the seam lies opposite
    angle = np.angle(np.exp(1j * (np.arctan2(away[:, 1], away[:, 0]) - direction)))
    length = max(float(np.ptp(distance)), float(np.median(distance)) * float(np.ptp(angle)) / 2)
    step = _cell_side(seen, length)
    pitch = np.array([step, step / float(np.median(distance))])
    radii = np.arange(distance.min(), distance.max(), pitch[0])
    turns = direction + np.arange(angle.min(), angle.max(), pitch[1])
    radius, turn = np.meshgrid(radii, turns)
    return _resample(seen, centre + radius[..., None] * np.stack([np.cos(turn), np.sin(turn)], -1), pitch)


def _resample(seen: PlanePixels, coordinates: np.ndarray, pitch: np.ndarray) -> PlaneMap | None:
    """The map at coordinates [h, w, 2] on the plane; None where it is too small, or the pixels fit no homography."""
    some = np.linspace(0, len(seen.coordinates) - 1, min(len(seen.coordinates), HOMOGRAPHY_PIXELS)).astype(int)
    points, pixels = (each[some].astype(np.float64) for each in (seen.coordinates, seen.pixels))
    homography, _ = cv2.findHomography(points, pixels, 0)
    if homography is None or min(coordinates.shape[:2]) < MIN_SIDE:
        return None
    at = cv2.perspectiveTransform(coordinates.reshape(1, -1, 2), homography).reshape(coordinates.shape)
    x, y = at.astype(np.float32)[..., 0], at.astype(np.float32)[..., 1]
    on_plane = np.zeros(seen.image.shape[:2], np.uint8)
    on_plane[seen.pixels[:, 1], seen.pixels[:, 0]] = 1
    on_plane = cv2.morphologyEx(on_plane, cv2.MORPH_CLOSE, np.ones((CLOSE_PX, CLOSE_PX)))
    values = cv2.remap(seen.image, x, y, cv2.INTER_LINEAR).astype(np.float32)
    return PlaneMap(values, cv2.remap(on_plane, x, y, cv2.INTER_NEAREST) > 0, pitch)


def _find_centre(plane_map: PlaneMap, draws: np.random.Generator) -> np.ndarray | None:
    """[2], the cell (x, y), perhaps outside the map, in which the texture's lines meet; None where they are rather
    parallel."""
    grey = cv2.GaussianBlur(plane_map.values.mean(2), (0, 0), 1.0)
    gradient = np.stack([cv2.Scharr(grey, cv2.CV_32F, *way) for way in ((1, 0), (0, 1))], -1)
    inner = cv2.erode(plane_map.known.astype(np.uint8), np.ones((7, 7)), borderValue=0) > 0
    length = np.linalg.norm(gradient, axis=-1) * inner
    steepest = np.argsort(-length, axis=None, kind="stable")[:MAX_EDGES]
    steepest = steepest[length.reshape(-1)[steepest] > 0]
    if len(steepest) < MIN_CELLS:
        return None
    rows, columns = np.unravel_index(steepest, length.shape)
    at = np.stack([columns, rows], 1).astype(np.float64)
    normals = gradient[rows, columns] / length[rows, columns, None]
    first, second = draws.integers(len(at), size=(2, LINE_PAIRS))
    crossing = np.linalg.det(np.stack([normals[first], normals[second]], 1))
    crosses = np.abs(crossing) > SIN_TOLERANCE
    heights = (normals * at).sum(1)
    a, b, p, q = normals[first][crosses], normals[second][crosses], heights[first][crosses], heights[second][crosses]
    points = np.stack([p * b[:, 1] - q * a[:, 1], a[:, 0] * q - b[:, 0] * p], 1) / crossing[crosses, None]
    middle = np.array(grey.shape[::-1]) / 2
    points = points[np.linalg.norm(points - middle, axis=1) < MAX_CENTRE_DISTANCE * SIDE]
    if not len(points):
        return None
    counts = [_meets(point, at, normals).sum() for point in points]
    parallel = max(int((np.abs(normals @ (-each[1], each[0])) < SIN_TOLERANCE).sum()) for each in normals[first])
    best = points[int(np.argmax(counts))]
    for _ in range(CENTRE_ITERATIONS):
        mine = _meets(best, at, normals)
        weight = 1 / np.maximum(np.linalg.norm(at[mine] - best, axis=1), MIN_SIDE / 2)[:, None]
        best = np.linalg.lstsq(normals[mine] * weight, heights[mine, None] * weight, rcond=None)[0][:, 0]
    return best if _meets(best, at, normals).sum() > MIN_CONVERGENCE * parallel else None


def _meets(point: np.ndarray, at: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """bool [L], which lines, through points `at` [L, 2] with unit normals [L, 2], go through a point [2]."""
    away = point - at
    return np.abs((normals * away).sum(1)) < SIN_TOLERANCE * np.linalg.norm(away, axis=1)
