"""Planes in disparity (1/z), where a plane is an affine function of the pixel: fits one, or joins several."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from reffusion.geometry import Degenerate

MIN_SAMPLES = 12  # four for each coefficient of a plane
MIN_SHARE = 0.03  # of the samples: with fewer unexplained samples no further plane is searched
MIN_GAIN = 0.03  # minimum increase of the explained share for which a plane joins
TRIALS = 500  # random triples of samples for each plane
MAX_PLANES = 6  # candidates


def fit_plane(disparity: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[H, W]: the affine function of the pixel that fits `disparity` [H, W] best in least squares under `weights`."""
    rows, columns = np.nonzero(weights > 0)
    width = disparity.shape[1]
    x, y, w = columns / width, rows / width, np.sqrt(weights[rows, columns])
    x0, y0 = x.mean(), y.mean()  # centred, which decouples slopes and offset
    design = np.stack([x - x0, y - y0, np.ones_like(x)], 1)
    a, b, c = np.linalg.lstsq(design * w[:, None], disparity[rows, columns] * w, rcond=None)[0]
    return plane_values((a, b, c - a * x0 - b * y0), disparity.shape)


def plane_values(coefficients: tuple[float, float, float], shape: tuple[int, int]) -> np.ndarray:
    """[H, W] values of a x + b y + c with x, y = (column, row) / width, where columns and rows are integers: at upper
    left corners of pixels."""
    rows, columns = np.mgrid[: shape[0], : shape[1]] / shape[1]
    a, b, c = coefficients
    return a * columns + b * rows + c


@dataclass(frozen=True)
class PlanarModel:
    """Disparity as maxima and minima of planes: rooms are concave (the nearer plane is visible), boxes convex.

    Attributes:
        disparity: [H, W] float64, at every pixel.
        explained: share of the surroundings within the tolerance, in [0, 1].
        planes: number of planes used.
    """

    disparity: np.ndarray
    explained: float
    planes: int


def planar_model(
    pixels: np.ndarray,
    disparity: np.ndarray,
    shape: tuple[int, int],
    generator: torch.Generator,
    *,
    tolerance: float = 0.01,
) -> PlanarModel:
    """Fit planes to the surroundings of a hole, and continue them until they intersect.

    Planes are found by sequential RANSAC: the best supported plane through three samples is refitted to its inliers,
    and these are removed. The model starts with the plane that explains most samples. Other planes join it as maximum
    or minimum if that explains more samples. So the plane of an object in front of a wall does not cut through the
    hole: as a maximum it would occlude the wall beside it.

    PAPER leaves open: the completion. This is the hypothesis for rooms; the smooth one is `completion.complete`.

    Args:
        pixels: [S, 2] image points of the samples around the hole, (x, y) in pixels.
        disparity: [S], positive.
        shape: (H, W) of the result.
        generator: on the CPU.
        tolerance: relative disparity within which a sample is explained.

    Raises:
        Degenerate: fewer than 12 samples, or all of them on one line.
    """
    scaled = np.column_stack([pixels / shape[1], np.ones(len(pixels))])
    if len(pixels) < MIN_SAMPLES or np.linalg.matrix_rank(scaled, tol=1e-6) < 3:
        raise Degenerate(
            "no plane", f"{len(pixels)} samples around the hole fix no plane: {MIN_SAMPLES} off one line are needed"
        )
    tolerances = tolerance * disparity
    planes = _find_planes(scaled, disparity, tolerances, generator)
    candidates = [scaled @ plane for plane in planes]
    explained_share = lambda values: np.mean(np.abs(values - disparity) < tolerances)
    start = max(range(len(planes)), key=lambda k: explained_share(candidates[k]))
    at_samples, model, count = candidates[start], _at_pixel_centers(planes[start], shape), 1
    while True:
        joins = [(join, k) for k in range(len(planes)) for join in (np.maximum, np.minimum)]
        join, k = max(joins, key=lambda option: explained_share(option[0](at_samples, candidates[option[1]])))
        joined = join(at_samples, candidates[k])
        if explained_share(joined) < explained_share(at_samples) + MIN_GAIN:
            return PlanarModel(model, float(explained_share(at_samples)), count)
        at_samples, model, count = joined, join(model, _at_pixel_centers(planes[k], shape)), count + 1


def _at_pixel_centers(plane: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """[H, W]: values of a plane at pixel centres."""
    a, b, c = plane
    return plane_values((a, b, c + 0.5 * (a + b) / shape[1]), shape)


def _find_planes(points, values, tolerances, generator) -> list[np.ndarray]:
    """Coefficients [3] of planes, at least one: values [S] ~ points [S, 3] @ plane within `tolerances` [S]."""
    unexplained, planes = np.ones(len(values), bool), []
    while unexplained.sum() >= max(MIN_SAMPLES, MIN_SHARE * len(values)) and len(planes) < MAX_PLANES:
        candidate = _best_supported_plane(points, values, tolerances, np.flatnonzero(unexplained), generator)
        if candidate is None:
            break
        planes.append(_refit_plane(candidate, points, values, tolerances, unexplained))
        unexplained &= np.abs(points @ planes[-1] - values) >= tolerances
    return planes or [np.linalg.lstsq(points, values, rcond=None)[0]]


def _best_supported_plane(points, values, tolerances, index, generator) -> np.ndarray | None:
    """The plane through three of the samples `index` with the most inliers; None if no three form a triangle."""
    triples = index[torch.randint(len(index), (TRIALS, 3), generator=generator).numpy()]
    is_triangle = np.abs(np.linalg.det(points[triples])) > 1e-4  # sides of about 1% of the width
    if not is_triangle.any():
        return None
    candidates = np.linalg.solve(points[triples[is_triangle]], values[triples[is_triangle]][..., None])[..., 0]
    sample = index[:: max(1, len(index) // 4000)]
    support = (np.abs(candidates @ points[sample].T - values[sample]) < tolerances[sample]).sum(1)
    return candidates[support.argmax()]


def _refit_plane(plane, points, values, tolerances, unexplained) -> np.ndarray:
    """The plane refitted to its inliers among the unexplained samples, alternately with choosing these."""
    inliers = unexplained & (np.abs(points @ plane - values) < tolerances)
    for _ in range(10):
        if inliers.sum() < 3:
            break
        plane = np.linalg.lstsq(points[inliers], values[inliers], rcond=None)[0]
        residual = np.abs(points @ plane - values)
        # Near a crease, samples of the other plane are within the tolerance, too, but exceed the plane's own noise.
        inliers = unexplained & (residual < np.minimum(tolerances, 4.0 * np.median(residual[inliers])))
    return plane
