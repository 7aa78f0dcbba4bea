"""Alignment of depth maps by a scale and an offset: pure functions on float64 arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from reffusion import geometry, seeding
from reffusion.geometry import Degenerate

Space = Literal["depth", "disparity"]

MIN_PIXELS = 4  # two unknowns, and two more pixels so that a residual can show
MIN_RELATIVE_SPREAD = 1e-6  # of the largest value; below it float32 input determines no slope
MAX_REWEIGHTINGS = 30
TRIALS = 1000  # lines through two pixels: with 10% inliers 1 in 100 has two; that none has happens once in 20,000 runs
# Pixels on which a line is judged: of 10% inliers 50 agree with the right line, a handful with a wrong one.
VOTERS = 500
SUPPORT_LEVELS = 32  # numbers of agreeing pixels that are compared
MAX_ERROR_RATIO = 0.7  # median error / spread of the known disparity, above which a map does not fit the scene
# A map counts as being in the scene's unit if its error without alignment is at most this many times the best fit's,
SAME_UNIT_RATIO = 1.5
SAME_UNIT_ERROR = 0.03  # or up to this relative error, which a map in another unit would hardly reach by chance
# A scene whose disparity varies less than this, relative to its median, is treated as varying this much.
MIN_DISPARITY_SPREAD = 0.02


@dataclass(frozen=True)
class Alignment:
    """A linear fit, target ~ scale * estimate + offset.

    Attributes:
        scale, offset: The fitted coefficients.
        residual: Weighted root mean square of target - fit, in the unit of the target. The weights are those of the
            fit, so for a robust fit outliers hardly count.
    """

    scale: float
    offset: float
    residual: float

    def apply(self, estimate: np.ndarray) -> np.ndarray:
        """Return scale * estimate + offset, float64."""
        return self.scale * np.asarray(estimate, np.float64) + self.offset


def align(
    estimate: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None, *, robust: bool = False, seed: int = 0
) -> Alignment:
    """Fit scale and offset by least squares on the pixels of positive weight (paper, depth supervision).

    The normal equations are solved about the weighted means and in units of the weighted spread, so that neither a
    large offset nor a large unit loses digits.

    Args:
        estimate, target: Arrays of the same shape, in any unit.
        weights: The same shape, >= 0, or bool to select pixels. None: all weights are 1.
        robust: Whether outliers are rejected. Up to 90 % of the pixels may be outliers, if there are at least a few
            hundred pixels and the outliers form no line themselves. The fit starts from the line whose support is least
            likely by chance, and continues by iteratively reweighted least squares with Geman-McClure weights.
        seed: Seed of the random samples of the robust fit.

    Raises:
        Degenerate: Fewer than 4 pixels have positive weight, or the spread of the estimate at these pixels is below
            1e-6 of its magnitude (a constant determines no scale).
        ValueError: Shapes differ, or a value at a pixel of positive weight is not finite.
    """
    estimate, target = np.asarray(estimate, np.float64), np.asarray(target, np.float64)
    weights = np.ones(estimate.shape) if weights is None else np.asarray(weights, np.float64)
    if not estimate.shape == target.shape == weights.shape:
        raise ValueError(f"alignment of arrays of different shapes: {estimate.shape}, {target.shape}, {weights.shape}")
    used = weights > 0
    x, y, w = estimate[used], target[used], weights[used]
    if x.size < MIN_PIXELS:
        raise Degenerate("few pixels", f"alignment needs at least {MIN_PIXELS} known pixels, got {x.size}")
    if not (np.isfinite(x).all() and np.isfinite(y).all() and np.isfinite(w).all()):
        raise ValueError("alignment got values that are not finite: leave those pixels out by weight 0")
    plain = _weighted_line(x, y, w)
    return _robust_line(x, y, w, plain, seeding.generator(seed, "align")) if robust else plain


def _robust_line(
    x: np.ndarray, y: np.ndarray, w: np.ndarray, plain: Alignment, generator: torch.Generator
) -> Alignment:
    """Return the robust fit of targets y to estimates x, [S] each, by M-estimation with weights w > 0, [S]."""
    # `plain` is the least-squares fit, the start if no line is better than chance.
    result, share = _consensus(x, y, w, generator) or (plain, 1.0)
    for _ in range(MAX_REWEIGHTINGS):
        error = np.abs(y - result.apply(x))
        spread = 1.4826 * np.quantile(error, 0.5 * share)  # the median error of the inliers
        if spread <= 1e-12 * np.abs(y).max():
            inlier = error <= 1e-9 * np.abs(y).max()  # an exact fit up to rounding: no weighting needed
            has_spread = np.ptp(x[inlier]) > MIN_RELATIVE_SPREAD * np.abs(x[inlier]).max()
            return _weighted_line(x[inlier], y[inlier], w[inlier]) if has_spread else result
        updated = _weighted_line(x, y, w * _geman_mcclure_weights(error, spread))
        change = np.abs(updated.apply(x) - result.apply(x)).max()
        result = updated
        if change < 1e-9 * np.abs(y).max():
            break
    return result


def _geman_mcclure_weights(error: np.ndarray, spread: float) -> np.ndarray:
    """Return the Geman-McClure weights, in (0, 1], of absolute residuals.

    Args:
        error: The absolute residuals, of any shape.
        spread: Standard deviation of the residuals of inliers, > 0.
    """
    return (1.0 + (error / (2.0 * spread)) ** 2) ** -2


def _consensus(
    x: np.ndarray, y: np.ndarray, w: np.ndarray, generator: torch.Generator
) -> tuple[Alignment, float] | None:
    """Return the line whose support is least likely by chance, and its share of support; None if none beats chance."""
    uniform = lambda count: torch.rand(count, generator=generator, dtype=torch.float64).numpy()
    edges = np.cumsum(w) / w.sum()
    first, second = (np.minimum(np.searchsorted(edges, uniform(TRIALS)), x.size - 1) for _ in range(2))
    voters = np.argsort(-np.log1p(-uniform(x.size)) / w)[:VOTERS]  # weighted sampling without replacement
    distance = x[second] - x[first]
    distinct = np.abs(distance) > MIN_RELATIVE_SPREAD * np.abs(x).max()
    if not distinct.any():
        return None
    first, slope = first[distinct], (y[second] - y[first])[distinct] / distance[distinct]
    predicted = y[first, None] + slope[:, None] * (x[voters] - x[first, None])
    # The criterion is a contrario, so no noise level has to be known. Suppose that x carries no information about y.
    # Let q be the share of pixels whose residual is at most r after the targets were shuffled. Then h of n residuals
    # are at most r with probability exp(-n KL(h/n || q)) (Chernoff). The line and the r with the largest exponent are
    # chosen. The pixels whose residual is at most r support the line.
    error = np.sort(np.abs(y[voters] - predicted), 1)
    shuffled = np.abs(y[voters][np.argsort(uniform(len(voters)))] - predicted)
    support = np.unique(np.geomspace(3, len(voters), SUPPORT_LEVELS).round().astype(int))
    share = (support - 2) / (len(voters) - 2)  # the two pixels of the line agree by construction
    within_chance = np.stack([(shuffled <= error[:, s - 1, None]).sum(1) for s in support], 1)
    chance = (within_chance + 1) / (len(voters) + 1)
    rest = np.log(np.maximum(1.0 - share, 1e-12) / np.maximum(1.0 - chance, 1e-12))
    surprise = np.where(share > chance, share * np.log(share / chance) + (1.0 - share) * rest, 0.0)
    if not surprise.any():
        return None
    trial, level = np.unravel_index(surprise.argmax(), surprise.shape)
    offset = y[first[trial]] - slope[trial] * x[first[trial]]
    line = Alignment(float(slope[trial]), float(offset), float(error[trial, support[level] - 1]))
    return line, float(support[level] / len(voters))


def _weighted_line(x: np.ndarray, y: np.ndarray, w: np.ndarray) -> Alignment:
    """Return the least-squares fit of y to x with weights w > 0, [S] each. Raises Degenerate if x is constant."""
    total = w.sum()
    x_mean, y_mean = (w @ x) / total, (w @ y) / total
    dx, dy = x - x_mean, y - y_mean
    spread = np.sqrt((w @ dx**2) / total)
    _check_not_constant(x, x_mean, spread)
    scale = (w @ (dx / spread * dy)) / total / spread
    residual = np.sqrt((w @ (dy - scale * dx) ** 2) / total)
    return Alignment(float(scale), float(y_mean - scale * x_mean), float(residual))


def _check_not_constant(x: np.ndarray, mean: float, spread: float) -> None:
    """Raise Degenerate if the spread of x, [S], is below `MIN_RELATIVE_SPREAD` of its largest value."""
    if spread <= MIN_RELATIVE_SPREAD * np.abs(x).max():
        raise Degenerate(
            "constant",
            f"alignment is degenerate: the estimate is constant ({mean:.6g}) on its {x.size} known pixels, "
            "which fixes no scale",
        )


def align_depth(
    estimate: np.ndarray, depth: np.ndarray, known: np.ndarray, *, space: Space = "disparity", robust: bool = False
) -> np.ndarray:
    """Return a monocular estimate aligned with the depth of the scene, [H, W] float64 camera z.

    PAPER leaves open: whether scale and offset act on depth or on its inverse. Both are offered. It must be the space
    of the estimator's output (Depth Anything returns disparity), since an offset in one is no offset in the other.

    Args:
        estimate: [H, W], an affine function of the scene's depth or disparity, according to `space`.
        depth: [H, W] the scene's depth, read where `known`.
        known: bool or weights [H, W]. Pixels with depth <= 0 do not count.
        space: The quantity of which the estimate is an affine function.
        robust: See `align`.

    Returns:
        The aligned estimate as depth, also at known pixels. Where the aligned disparity is negative, NaN or less than
            1/1000 of that of the largest known depth, this depth replaces it. With `space` "depth", the smallest known
            depth replaces aligned depths that are NaN or not positive.

    Raises:
        Degenerate: As `align`.
        ValueError: As `align`, or the fitted scale is negative, i.e. the estimate is of the other space.
    """
    depth = np.asarray(depth, np.float64)
    weights = np.asarray(known, np.float64) * (depth > 0)
    target = depth if space == "depth" else geometry.reciprocal(depth)
    fit = align(estimate, target, weights, robust=robust)
    known_values = np.asarray(estimate, np.float64)[weights > 0]
    rise = fit.scale * np.ptp(known_values)  # zero up to rounding where the scene's depth is constant, which is allowed
    if rise < -1e-12 * target.max():
        other = "depth" if space == "disparity" else "disparity"
        raise ValueError(f"the estimate falls where the scene's {space} grows: is it {other}?")
    aligned, farthest = fit.apply(estimate), depth[weights > 0].max()
    if space == "depth":
        nearest = depth[weights > 0].min()
        return np.where(aligned > 0, aligned, nearest)
    return np.divide(1.0, aligned, out=np.full(aligned.shape, farthest), where=aligned > 1.0 / (1e3 * farthest))


def align_either(estimate: np.ndarray, depth: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, Space]:
    """Align a map, of which it is unknown whether it is depth or disparity, with the depth of the scene.

    The map is aligned robustly both as depth and as disparity. Of the alignments with a positive scale, the one with
    the smaller error in disparity is kept. The map stays unchanged if it is positive and, read as depth in the scene's
    unit, fits about as well (`SAME_UNIT_RATIO`) or within `SAME_UNIT_ERROR`, so that the maps of several references
    stay consistent with each other.

    Args:
        estimate: [H, W], depth or disparity of any scale and offset, NaN where unknown.
        depth: [H, W] the scene's depth, read where `known`.
        known: bool or weights [H, W]. Pixels with depth <= 0 do not count.

    Returns:
        depth: [H, W] float64 camera z, NaN where the estimate is NaN. The largest known depth replaces depths of
            at least 1000 times this depth, or beyond infinity. The smallest known depth replaces depths behind the
            camera.
        space: The quantity of which the map is an affine function, "depth" or "disparity".

    Raises:
        Degenerate: There are too few known pixels, or the map is constant there.
        ValueError: The map falls where the scene's depth grows and also where the scene's disparity grows, or the map
            fits neither.
    """
    valid = np.isfinite(estimate)
    estimate, depth = np.where(valid, estimate, 0.0).astype(np.float64), np.asarray(depth, np.float64)
    weights = np.asarray(known, np.float64) * (depth > 0) * valid
    used = weights > 0
    candidates: dict[Space, tuple[float, np.ndarray]] = {}
    for space in ("disparity", "depth"):
        try:
            aligned = align_depth(estimate, depth, weights, space=space, robust=True)
        except Degenerate:
            raise
        except ValueError:
            continue
        candidates[space] = (float(np.median(np.abs(1 / aligned[used] - 1 / depth[used]))), aligned)
    if not candidates:
        raise ValueError("the depth map falls where the scene's depth grows, and where its disparity does; invert it")
    space = min(candidates, key=lambda each: candidates[each][0])
    error, aligned = candidates[space]
    disparity = 1 / depth[used]
    spread = float(np.median(np.abs(disparity - np.median(disparity))))
    if error > MAX_ERROR_RATIO * max(spread, MIN_DISPARITY_SPREAD * float(np.median(disparity))):
        raise ValueError(
            f"the depth map does not fit what is seen: half of it misses by {error / np.median(disparity):.0%} of the "
            f"disparity or more, and the scene's own varies by {spread / np.median(disparity):.0%}"
        )
    in_unit = estimate[used]
    in_unit_error = float(np.median(np.abs(geometry.reciprocal(in_unit) - disparity)))
    tolerance = max(SAME_UNIT_RATIO * error, SAME_UNIT_ERROR * float(np.median(disparity)))
    if (estimate[valid] > 0).all() and in_unit_error <= tolerance:
        return np.where(valid, estimate, np.nan), "depth"
    return np.where(valid, aligned, np.nan), space
