"""Detection of how a plane's texture repeats itself: motions along the plane that map the texture onto itself.

Such a motion maps planks onto planks, or tiles onto tiles. A photograph of the plane is resampled to a map in metric
coordinates on the plane, and the map is correlated with itself. A peak of the correlation is a shift that maps the
texture onto itself, in every photograph. If the lines of the texture meet in one point, as the joints of a round table
do, the motions are turns about this point instead. They are found in a polar map about it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from reffusion import seeding

SIDE = 224  # cells, longest side of a plane's map
MIN_SIDE = 16  # cells, shortest side that a map may have
MIN_CELLS = 400  # cells of the plane that must be seen
MIN_OVERLAP = 0.1  # share of the seen cells that must overlap after a motion; at least `MIN_CELLS` cells must
SHADING_SIGMA = 6.0  # cells: blur that separates shading, which is not compared, from texture
MIN_SHIFT = 3  # cells: smaller shifts are ignored, since every texture resembles itself there
MIN_CORRELATION = 0.6  # correlation that the best motion must reach; stone reaches 0.5, planks 0.7
MIN_OF_BEST = 0.5  # share of `MIN_CORRELATION` that the other motions must reach
MIN_OF_PEAK = 0.75  # share of the highest peak that the basic turn, of which all others are multiples, must exceed
TURN_TOLERANCE = 0.2  # of the basic turn: distance by which a peak may miss the multiple that it stands for
MAX_MOTIONS = 60
PEAK_WINDOW = 9  # cells, side of the window that has one peak
MIN_SHIFTS = 4  # shifts that a plane must have, for example a shift and its double, in both directions
CLOSE_PX = 9  # px: gaps in the pixels of a plane up to this width are closed, since uneven depth leaves such gaps
MAX_EDGES, LINE_PAIRS = 3000, 400  # steepest cells, whose edges are taken as lines; pairs of lines that are intersected
SIN_TOLERANCE = 0.035  # sine of the angle by which a line may miss the center
MIN_CONVERGENCE = 1.25  # this many times as many lines must meet in the center as are parallel to each other
MAX_CENTER_DISTANCE = 3.0  # distance from the map's middle within which the center is sought, in units of `SIDE`
CENTER_REACH = 8.0  # cells to each side of the first estimate of the center within which the center is refined
CENTER_STEPS, MIN_GAIN = (2.0, 1.0, 0.5), 1e-3  # cells, steps of the refinement; gain in correlation that continues it
CENTER_ITERATIONS = 5  # iterations of the least squares fit of the center to its lines
HOMOGRAPHY_PIXELS = 2000  # pixels to which the homography is fitted
SEED = 0  # seed of the random pairs of lines


@dataclass(frozen=True)
class PlaneSymmetry:
    """The motions along a plane that map its texture onto itself: all shifts, or all turns about one center.

    Attributes:
        center: [2], the point on the plane about which the texture turns; None if the motions are shifts.
        motions: [M, 2], shifts in world units, those of the highest correlation first; or [M, 1], turns in radians, in
            both directions, the smallest first.
        resolution: the accuracy of the motions, in world units: the side of a cell of the map. For turns it is the
            accuracy of the positions of turned points.
    """

    center: np.ndarray | None
    motions: np.ndarray
    resolution: float

    def move(self, points: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """Return the points on the plane, [N, 2], after a motion: a shift, [2], or a turn, [1]."""
        if self.center is None:
            return points + motion
        cosine, sine = np.cos(motion[0]), np.sin(motion[0])
        return (points - self.center) @ np.array([[cosine, sine], [-sine, cosine]]) + self.center

    def rotation(self, motion: np.ndarray) -> np.ndarray:
        """Return [2, 2], the derivative of `move` by the point: a rotation matrix for a turn, else the identity."""
        angle = 0.0 if self.center is None else motion[0]
        return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


class PlanePixels(NamedTuple):
    """The pixels of an image that show a plane.

    Attributes:
        pixels: [M, 2] int (x, y).
        coordinates: [M, 2], their coordinates on the plane, in world units.
        image: uint8 [H, W, 3].
    """

    pixels: np.ndarray
    coordinates: np.ndarray
    image: np.ndarray


class PlaneMap(NamedTuple):
    """The texture of a plane, sampled on a grid of cells.

    Attributes:
        values: [h, w, 3] float32, colors in levels of 255.
        known: bool [h, w], True where the image shows the plane.
        pitch: [2], the sides of a cell along x and y, in world units. In a polar map these are the steps of the radius,
            in world units, and of the angle, in radians.
    """

    values: np.ndarray
    known: np.ndarray
    pitch: np.ndarray


def find_symmetry(seen: PlanePixels) -> PlaneSymmetry | None:
    """Find how the texture of a plane repeats itself.

    Args:
        seen: the pixels of an image that show the plane.

    Returns:
        None if no motion maps the texture onto itself well enough, or too little of the plane is visible.
    """
    low, high = seen.coordinates.min(0), seen.coordinates.max(0)
    plane_map = _cartesian_map(seen, low, high)
    if plane_map is None:
        return None
    cell = _find_center(plane_map, np.random.default_rng(seeding.seed_for(SEED, "lines")))
    if cell is None:
        motions = _find_shifts(_autocorrelation(plane_map)) * plane_map.pitch
        return PlaneSymmetry(None, motions, plane_map.pitch[0]) if len(motions) else None
    center, polar = _refine_center(seen, low + cell * plane_map.pitch, plane_map.pitch[0])
    if polar is None:
        return None
    motions = _find_turns(_autocorrelation(polar)[:, 0], 2 * np.pi / polar.pitch[1]) * polar.pitch[1]
    return PlaneSymmetry(center, motions[:, None], polar.pitch[0]) if len(motions) else None


def _refine_center(seen: PlanePixels, center: np.ndarray, cell: float) -> tuple[np.ndarray, PlaneMap | None]:
    """Return the refined center about which the texture turns, and the polar map about it, None if there is none."""

    # The score is averaged over all turns. One turn alone would not do, because a short arc fits many circles, and so
    # correlates about wrong centers too. If fewer than two turns are seen, the first estimate stays.
    def judge(at: np.ndarray) -> tuple[float, PlaneMap | None]:
        polar = _polar_map(seen, at)
        return (
            -1.0 if polar is None else _mean_correlation(_autocorrelation(polar)[:, 0], 2 * np.pi / polar.pitch[1]),
            polar,
        )

    coarse = np.arange(-CENTER_REACH, CENTER_REACH + 1, CENTER_STEPS[0])
    starts = [center + cell * np.array([x, y]) for y in coarse for x in coarse]
    scores = [judge(start)[0] for start in starts]
    if max(scores) > 0:
        center = starts[int(np.argmax(scores))]
    best, polar = judge(center)
    for step in CENTER_STEPS[1:]:
        for side in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            while (score := judge(center + step * cell * np.array(side)))[0] > best + MIN_GAIN:
                (best, polar), center = score, center + step * cell * np.array(side)
    return center, polar


def _mean_correlation(correlation: np.ndarray, full_turn: float) -> float:
    """Average a correlation [h] over the texture's turns that are seen, 0 if fewer than two; `full_turn` is in rows."""
    turns = _find_turns(correlation, full_turn)
    values = np.interp(turns[turns > 0], np.arange(len(correlation)), correlation)
    values = values[values != 0]
    return float(values.mean()) if len(values) > 1 else 0.0


def _autocorrelation(plane_map: PlaneMap) -> np.ndarray:
    """Return the normalized correlation [h, w] of a map with itself after shifts by cells, ordered as in an FFT."""
    known = cv2.erode(plane_map.known.astype(np.uint8), np.ones((5, 5)), borderValue=0) > 0
    gray = plane_map.values.mean(2)
    detail = np.where(known, gray - cv2.GaussianBlur(gray, (0, 0), SHADING_SIGMA), 0.0).astype(np.float64)
    size = [cv2.getOptimalDFTSize(2 * side) for side in detail.shape]
    picture, mask, power = (np.fft.rfft2(each, size) for each in (detail, known.astype(float), detail**2))
    back = lambda spectrum: np.fft.irfft2(spectrum, size)
    both = np.sqrt(np.maximum(back(power * mask.conj()) * back(power.conj() * mask), 1e-6))
    enough = back(np.abs(mask) ** 2) > max(MIN_CELLS, MIN_OVERLAP * known.sum())
    # 0 where too few cells overlap after the shift
    return np.where(enough, back(np.abs(picture) ** 2) / both, 0.0)


def _find_shifts(correlation: np.ndarray) -> np.ndarray:
    """Return the shifts (x, y) in cells, [M, 2], at an autocorrelation's peaks, highest first; none if low or few."""
    height, width = (side // 2 for side in correlation.shape)
    centered = np.fft.fftshift(correlation)
    peak = (centered == ndimage.maximum_filter(centered, PEAK_WINDOW)) & (centered > MIN_OF_BEST * MIN_CORRELATION)
    peak[height - MIN_SHIFT : height + MIN_SHIFT + 1, width - MIN_SHIFT : width + MIN_SHIFT + 1] = False
    rows, columns = np.nonzero(peak)
    order = np.argsort(-centered[rows, columns], kind="stable")[:MAX_MOTIONS]
    if len(order) < MIN_SHIFTS or centered[rows, columns].max() < MIN_CORRELATION:
        return np.zeros((0, 2))
    return np.stack([columns[order] - width, rows[order] - height], 1).astype(np.float64)


def _find_turns(correlation: np.ndarray, full_turn: float) -> np.ndarray:
    """Return the turns, in rows [M], that map the texture onto itself, in both directions; M = 0 if there are none."""
    half = correlation[: min(len(correlation) // 2, int(full_turn / 2) + 1)]
    rows = np.arange(MIN_SHIFT, len(half) - 1)
    peak = (half[rows] > half[rows - 1]) & (half[rows] >= half[rows + 1]) & (half[rows] > MIN_OF_BEST * MIN_CORRELATION)
    rows = rows[peak]
    if not len(rows) or half[rows].max() < MIN_CORRELATION:
        return np.zeros(0)
    before, at, after = (half[rows + step] for step in (-1, 0, 1))
    exact = rows + 0.5 * (before - after) / (before - 2 * at + after)
    # the basic turn: the smallest whose correlation is about as high as that of any other
    first = exact[half[rows] > MIN_OF_PEAK * half[rows].max()].min()
    turns = []
    for k in range(1, int(full_turn / 2 / first) + 1):
        off = np.abs(exact - k * first)
        # a multiple of the basic turn near a peak takes its position
        turns.append(exact[off.argmin()] if off.min() < TURN_TOLERANCE * first else k * first)
    return np.array([way * turn for turn in turns[: MAX_MOTIONS // 2] for way in (1, -1)])


def _cartesian_map(seen: PlanePixels, low: np.ndarray, high: np.ndarray) -> PlaneMap | None:
    """Return the map of the rectangle between two corners, [2] each, along the plane's axes; None as in `_resample`."""
    pitch = np.full(2, _cell_side(seen, float((high - low).max())))
    steps = [low[axis] + pitch[axis] * np.arange(int((high - low)[axis] / pitch[axis]) + 1) for axis in (0, 1)]
    return _resample(seen, np.stack(np.meshgrid(*steps), -1), pitch)


def _cell_side(seen: PlanePixels, length: float) -> float:
    """Return the side of a cell, in world units, for a map whose longest side is `length`."""
    area = cv2.contourArea(cv2.convexHull(seen.coordinates.astype(np.float32)))
    # at most `SIDE` cells along a side, on average no smaller than the pixels of the image
    return max(length / SIDE, (area / len(seen.coordinates)) ** 0.5, 1e-9)


def _polar_map(seen: PlanePixels, center: np.ndarray) -> PlaneMap | None:
    """Return the polar map about a center, with a column per radius and a row per angle; None as in `_resample`."""
    away = seen.coordinates - center
    distance = np.hypot(*away.T)
    direction = np.angle(np.exp(1j * np.arctan2(away[:, 1], away[:, 0])).mean())  # the jump of the angle lies opposite
    angle = np.angle(np.exp(1j * (np.arctan2(away[:, 1], away[:, 0]) - direction)))
    length = max(float(np.ptp(distance)), float(np.median(distance)) * float(np.ptp(angle)) / 2)
    step = _cell_side(seen, length)
    # cells are square at the median radius
    pitch = np.array([step, step / float(np.median(distance))])
    radii = np.arange(distance.min(), distance.max(), pitch[0])
    turns = direction + np.arange(angle.min(), angle.max(), pitch[1])
    radius, turn = np.meshgrid(radii, turns)
    return _resample(seen, center + radius[..., None] * np.stack([np.cos(turn), np.sin(turn)], -1), pitch)


def _resample(seen: PlanePixels, coordinates: np.ndarray, pitch: np.ndarray) -> PlaneMap | None:
    """Sample the image at plane coordinates [h, w, 2]; None if the map is too small or no homography fits."""
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


def _find_center(plane_map: PlaneMap, draws: np.random.Generator) -> np.ndarray | None:
    """Return the point (x, y), in cells, where the texture's lines meet; None if they are rather parallel or few."""
    gray = cv2.GaussianBlur(plane_map.values.mean(2), (0, 0), 1.0)
    gradient = np.stack([cv2.Scharr(gray, cv2.CV_32F, *way) for way in ((1, 0), (0, 1))], -1)
    inner = cv2.erode(plane_map.known.astype(np.uint8), np.ones((7, 7)), borderValue=0) > 0
    length = np.linalg.norm(gradient, axis=-1) * inner
    # each steep edge is a line
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
    middle = np.array(gray.shape[::-1]) / 2
    points = points[np.linalg.norm(points - middle, axis=1) < MAX_CENTER_DISTANCE * SIDE]
    if not len(points):
        return None
    # the center, perhaps outside the map, is the point that the most lines pass through
    counts = [_meets(point, at, normals).sum() for point in points]
    parallel = max(int((np.abs(normals @ (-each[1], each[0])) < SIN_TOLERANCE).sum()) for each in normals[first])
    best = points[int(np.argmax(counts))]
    for _ in range(CENTER_ITERATIONS):
        mine = _meets(best, at, normals)
        weight = 1 / np.maximum(np.linalg.norm(at[mine] - best, axis=1), MIN_SIDE / 2)[:, None]
        best = np.linalg.lstsq(normals[mine] * weight, heights[mine, None] * weight, rcond=None)[0][:, 0]
    return best if _meets(best, at, normals).sum() > MIN_CONVERGENCE * parallel else None


def _meets(point: np.ndarray, at: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return which lines (a point `at` and a unit normal each) pass through a point up to a small angle, bool [L]."""
    away = point - at
    return np.abs((normals * away).sum(1)) < SIN_TOLERANCE * np.linalg.norm(away, axis=1)
