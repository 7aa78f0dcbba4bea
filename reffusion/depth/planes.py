"""Planes in disparity (1/z), where a plane is an affine function of the pixel: the fit of one plane, or of several."""

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
    """Return [H, W], the affine function of the pixel that fits a disparity map best in weighted least squares.

    Args:
        disparity: [H, W], read where the weight is positive.
        weights: [H, W] >= 0, with at least one positive value.
    """
    rows, columns = np.nonzero(weights > 0)
    width = disparity.shape[1]
    x, y, w = columns / width, rows / width, np.sqrt(weights[rows, columns])
    x0, y0 = x.mean(), y.mean()  # centered, which decouples slopes and offset
    design = np.stack([x - x0, y - y0, np.ones_like(x)], 1)
    a, b, c = np.linalg.lstsq(design * w[:, None], disparity[rows, columns] * w, rcond=None)[0]
    return plane_values((a, b, c - a * x0 - b * y0), disparity.shape)


def plane_values(coefficients: tuple[float, float, float], shape: tuple[int, int]) -> np.ndarray:
    """Return [H, W], the values a x + b y + c of a plane at the upper left corners of the pixels.

    Here x = column / width and y = row / width, with integer columns and rows.

    Args:
        coefficients: (a, b, c).
        shape: (H, W).
    """
    rows, columns = np.mgrid[: shape[0], : shape[1]] / shape[1]
    a, b, c = coefficients
    return a * columns + b * rows + c


@dataclass(frozen=True)
class PlanarModel:
    """A disparity map that consists of planes, joined by maxima and minima.

    At each pixel of a room the nearer plane is visible, i.e. the maximum of the disparities. At each pixel of a box the
    farther plane is visible, i.e. the minimum.

    Attributes:
        disparity: [H, W] float64, at every pixel.
        explained: Share of the samples around the hole, in [0, 1], whose disparity agrees with the model.
        planes: Number of planes used.
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
    """Fit planes to the surroundings of a hole, and continue them through the hole until they intersect.

    Planes are found by sequential RANSAC: the plane through three samples with the most inliers is refitted to its
    inliers, and these are removed before the next plane is searched. The model starts with the plane that explains most
    samples. Another plane joins it as maximum or minimum if the result explains clearly more samples (by `MIN_GAIN` of
    all samples). This excludes, for example, the plane of an object in front of a wall: as a maximum it would occlude
    samples of the wall beside the object.

    PAPER leaves open: the completion. This is the hypothesis for rooms; the smooth one is `completion.complete`.

    Args:
        pixels: [S, 2] image points (x, y) of the samples around the hole, in pixels.
        disparity: [S] of the samples, positive.
        shape: (H, W) of the result.
        generator: Draws the triples of samples; on the CPU.
        tolerance: Relative difference in disparity below which a plane explains a sample.

    Raises:
        Degenerate: There are fewer than 12 samples, or all of them lie on one line.
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
    """Return [H, W], the values of a plane, given by its coefficients [3], at pixel centers."""
    a, b, c = plane
    return plane_values((a, b, c + 0.5 * (a + b) / shape[1]), shape)


def _find_planes(points, values, tolerances, generator) -> list[np.ndarray]:
    """Return the coefficients [3] of each plane found, at least one, in the disparities `values` [S]."""
    # A row of `points` is a sample's image point divided by the image's width, and 1. A plane explains a sample if
    # points @ plane is within `tolerances` of the disparity.
    unexplained, planes = np.ones(len(values), bool), []
    while unexplained.sum() >= max(MIN_SAMPLES, MIN_SHARE * len(values)) and len(planes) < MAX_PLANES:
        candidate = _best_supported_plane(points, values, tolerances, np.flatnonzero(unexplained), generator)
        if candidate is None:
            break
        planes.append(_refit_plane(candidate, points, values, tolerances, unexplained))
        unexplained &= np.abs(points @ planes[-1] - values) >= tolerances
    return planes or [np.linalg.lstsq(points, values, rcond=None)[0]]


def _best_supported_plane(points, values, tolerances, index, generator) -> np.ndarray | None:
    """Return the plane [3] through three samples of `index` with the most inliers; None if no triple is a triangle."""
    triples = index[torch.randint(len(index), (TRIALS, 3), generator=generator).numpy()]
    is_triangle = np.abs(np.linalg.det(points[triples])) > 1e-4  # sides of about 1% of the width
    if not is_triangle.any():
        return None
    candidates = np.linalg.solve(points[triples[is_triangle]], values[triples[is_triangle]][..., None])[..., 0]
    sample = index[:: max(1, len(index) // 4000)]
    support = (np.abs(candidates @ points[sample].T - values[sample]) < tolerances[sample]).sum(1)
    return candidates[support.argmax()]


def _refit_plane(plane, points, values, tolerances, unexplained) -> np.ndarray:
    """Return the plane [3], refitted by least squares to its inliers among the unexplained samples."""
    inliers = unexplained & (np.abs(points @ plane - values) < tolerances)
    # Fitting and the choice of inliers alternate.
    for _ in range(10):
        if inliers.sum() < 3:
            break
        plane = np.linalg.lstsq(points[inliers], values[inliers], rcond=None)[0]
        residual = np.abs(points @ plane - values)
        # Near a crease, samples of the other plane are within the tolerance, too, but exceed the plane's own noise.
        inliers = unexplained & (residual < np.minimum(tolerances, 4.0 * np.median(residual[inliers])))
    return plane
