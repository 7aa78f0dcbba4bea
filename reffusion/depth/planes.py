"""Planes in disparity (1/z): there a plane is an affine function of the pixel. One is fitted, several are joined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from reffusion.geometry import Degenerate

LEAST_SAMPLES = 12  # four for each coefficient of a plane
LEAST_SHARE = 0.03  # of the samples: fewer are not searched for a further plane


def fit_plane(disparity: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The affine function of the pixel that fits `disparity` [H, W] best in L2 under `weights`, as [H, W] values."""
    rows, columns = np.nonzero(weights > 0)
    width = disparity.shape[1]
    x, y, w = columns / width, rows / width, np.sqrt(weights[rows, columns])
    x0, y0 = x.mean(), y.mean()  # centred: the slopes do not fight the offset
    design = np.stack([x - x0, y - y0, np.ones_like(x)], 1)
    a, b, c = np.linalg.lstsq(design * w[:, None], disparity[rows, columns] * w, rcond=None)[0]
    return plane_values((a, b, c - a * x0 - b * y0), disparity.shape)


def plane_values(coefficients: tuple[float, float, float], shape: tuple[int, int]) -> np.ndarray:
    """[H, W] values of a x + b y + c with x, y = (column, row) / width."""
    rows, columns = np.mgrid[: shape[0], : shape[1]] / shape[1]
    a, b, c = coefficients
    return a * columns + b * rows + c


@dataclass(frozen=True)
class PlanarModel:
    """Disparity as maxima and minima of planes: rooms are concave (the nearer plane shows), boxes convex.

    Attributes:
        disparity: [H, W] float64, everywhere.
        explained: share of the surroundings within the tolerance, in [0, 1].
        planes: how many planes take part.
    """

    disparity: np.ndarray
    explained: float
    planes: int


def planar_model(
    pixels: np.ndarray,
    disparity: np.ndarray,
    shape: tuple[int, int],
    draws: torch.Generator,
    *,
    tolerance: float = 0.01,
    gain: float = 0.03,
    trials: int = 500,
    most_planes: int = 6,
) -> PlanarModel:
    """The planes that surround a hole, continued until they meet.

    Planes are found one after another among the samples (three drawn, the best supported plane fitted to its own, these
    set aside). Starting with the best supported one, each of the others joins as maximum or as minimum with the model
    so far, if that explains more of the samples. So the plane of something that stands before the wall does not cut
    through the hole: as a maximum it would hide the wall beside it.

    PAPER leaves open: the completion. This is the hypothesis for rooms; the smooth one is `depth.complete`.

    Args:
        pixels: [S, 2] image points of the samples around the hole, (x, y) in pixels.
        disparity: [S], positive.
        shape: (H, W) of the model wanted.
        draws: a CPU generator.
        tolerance: relative disparity within which a sample is explained.
        gain: least growth of the explained share for which a plane joins.
        trials: draws of three samples for each plane.
        most_planes: candidates.

    Raises:
        Degenerate: fewer than 12 samples, or all on one line.
    """
    scaled = np.column_stack([pixels / shape[1], np.ones(len(pixels))])
    if len(pixels) < LEAST_SAMPLES or np.linalg.matrix_rank(scaled, tol=1e-6) < 3:
        raise Degenerate(
            "no plane", f"{len(pixels)} samples around the hole fix no plane: {LEAST_SAMPLES} off one line are needed"
        )
    near = tolerance * disparity
    planes = _planes_in(scaled, disparity, near, draws, trials, most_planes)
    candidates = [scaled @ plane for plane in planes]
    fits = lambda values: np.mean(np.abs(values - disparity) < near)
    start = max(range(len(planes)), key=lambda k: fits(candidates[k]))
    at_samples, whole, used = candidates[start], _at_centres(planes[start], shape), 1
    while True:
        ways = [(join, k) for k in range(len(planes)) for join in (np.maximum, np.minimum)]
        join, k = max(ways, key=lambda way: fits(way[0](at_samples, candidates[way[1]])))
        joined = join(at_samples, candidates[k])
        if fits(joined) < fits(at_samples) + gain:
            return PlanarModel(whole, float(fits(at_samples)), used)
        at_samples, whole, used = joined, join(whole, _at_centres(planes[k], shape)), used + 1


def _at_centres(plane: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """[H, W] at pixel centres."""
    a, b, c = plane
    return plane_values((a, b, c + 0.5 * (a + b) / shape[1]), shape)


def _planes_in(points, values, near, draws, trials, most_planes) -> list[np.ndarray]:
    """Coefficients [3] of planes, values [S] ~ points [S, 3] @ plane within `near` [S], each fitted to its own samples;
    at least one."""
    free, planes = np.ones(len(values), bool), []
    while free.sum() >= max(LEAST_SAMPLES, LEAST_SHARE * len(values)) and len(planes) < most_planes:
        drawn = _best_drawn(points, values, near, np.flatnonzero(free), draws, trials)
        if drawn is None:
            break
        planes.append(_settled(drawn, points, values, near, free))
        free &= np.abs(points @ planes[-1] - values) >= near
    return planes or [np.linalg.lstsq(points, values, rcond=None)[0]]


def _best_drawn(points, values, near, index, draws, trials) -> np.ndarray | None:
    """Of planes through three of the samples `index` each, the one that most of them support; None for no triangle."""
    picks = index[torch.randint(len(index), (trials, 3), generator=draws).numpy()]
    regular = np.abs(np.linalg.det(points[picks])) > 1e-4  # a triangle of about 1% of the width a side
    if not regular.any():
        return None
    trial = np.linalg.solve(points[picks[regular]], values[picks[regular]][..., None])[..., 0]
    sample = index[:: max(1, len(index) // 4000)]
    support = (np.abs(trial @ points[sample].T - values[sample]) < near[sample]).sum(1)
    return trial[support.argmax()]


def _settled(plane, points, values, near, free) -> np.ndarray:
    """The plane fitted to its own among the free samples, these chosen anew each time."""
    inliers = free & (np.abs(points @ plane - values) < near)
    for _ in range(10):
        if inliers.sum() < 3:
            break
        plane = np.linalg.lstsq(points[inliers], values[inliers], rcond=None)[0]
        misfit = np.abs(points @ plane - values)
        # Beside a crease the other plane's samples are near, too: they stand out from the plane's own noise.
        inliers = free & (misfit < np.minimum(near, 4.0 * np.median(misfit[inliers])))
    return plane
