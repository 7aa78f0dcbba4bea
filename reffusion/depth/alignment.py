"""The alignment of depth maps by a scale and an offset: pure functions on float64 arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from reffusion import geometry, seeding
from reffusion.geometry import Degenerate

Space = Literal["depth", "disparity"]

LEAST_PIXELS = 4  # two unknowns, and as many pixels again to notice a misfit
LEAST_SPREAD = 1e-6  # relative; below it float32 input carries no slope
REWEIGHTINGS = 30
TRIALS = 1000  # of two pixels: of 10% inliers both are in one of a hundred; all miss them once in 20,000 times
JURY = 500  # pixels that judge a trial: of 10% inliers 50 agree with the right line, with a wrong one a handful
SUPPORTS = 32  # numbers of agreeing pixels that are looked at
DISAGREES = 0.7  # of the spread of what is known: half the pixels missing by more, and a map says nothing of the scene
AS_IT_IS = 1.5  # times the best fit's error, up to which a map counts as being in the scene's unit
BY_CHANCE = 0.03  # relative error of a map as it is: one in another unit would hardly come as near by chance
LEAST_DISPARITY = 0.02  # relative; a scene that varies less is flat, and any map that is right to this fits


@dataclass(frozen=True)
class Alignment:
    """target ~ scale * estimate + offset.

    Attributes:
        scale, offset: the fitted coefficients.
        residual: weighted root mean square of target - fit, in the target's unit.
    """

    scale: float
    offset: float
    residual: float

    def apply(self, estimate: np.ndarray) -> np.ndarray:
        return self.scale * np.asarray(estimate, np.float64) + self.offset


def align(
    estimate: np.ndarray,
    target: np.ndarray,
    weights: np.ndarray | None = None,
    *,
    robust: bool = False,
    seed: int = 0,
) -> Alignment:
    """Scale and offset by L2 on the pixels of positive weight (paper, depth supervision).

    The normal equations are solved about the weighted means and in units of the weighted spread, so that neither a
    large offset nor a large unit costs digits.

    Args:
        estimate, target: arrays of one shape, any unit.
        weights: same shape, >= 0 (bool for a choice of pixels); None: all ones.
        robust: let go of outliers, up to 90% of a few hundred pixels or more where these form no line themselves: from
            the line that chance explains least, iteratively reweighted least squares with Geman-McClure weights.
        seed: of the robust start's draws.

    Raises:
        Degenerate: fewer than 4 pixels of positive weight, or an estimate whose spread there is under 1e-6 of its
            magnitude (a constant fixes no scale).
        ValueError: shapes that differ, or values that are not finite.
    """
    estimate, target = np.asarray(estimate, np.float64), np.asarray(target, np.float64)
    weights = np.ones(estimate.shape) if weights is None else np.asarray(weights, np.float64)
    if not estimate.shape == target.shape == weights.shape:
        raise ValueError(f"alignment of arrays of different shapes: {estimate.shape}, {target.shape}, {weights.shape}")
    chosen = weights > 0
    x, y, w = estimate[chosen], target[chosen], weights[chosen]
    if x.size < LEAST_PIXELS:
        raise Degenerate("few pixels", f"alignment needs at least {LEAST_PIXELS} known pixels, got {x.size}")
    if not (np.isfinite(x).all() and np.isfinite(y).all() and np.isfinite(w).all()):
        raise ValueError("alignment got values that are not finite: leave those pixels out by weight 0")
    plain = _weighted_line(x, y, w)
    return _robust_line(x, y, w, plain, seeding.generator(seed, "align")) if robust else plain


def condition(estimate: np.ndarray, weights: np.ndarray | None = None) -> tuple[float, float]:
    """Condition numbers of the alignment's normal equations: plain (scale and offset), and as `align` solves them.

    Those of `align` are about the weighted mean and in units of the weighted spread: two equations that do not know of
    each other. What remains is the rounding of the mean, relative to the spread.

    Args: as `align`, the estimate not constant.
    """
    estimate = np.asarray(estimate, np.float64)
    weights = np.ones(estimate.shape) if weights is None else np.asarray(weights, np.float64)
    x, root = estimate[weights > 0], np.sqrt(weights[weights > 0])
    center = np.average(x, weights=root**2)
    spread = np.sqrt(np.average((x - center) ** 2, weights=root**2))
    squared = lambda column: float(np.linalg.cond(np.stack([column * root, root], 1)) ** 2)
    return squared(x), squared((x - center) / spread)


def _robust_line(x: np.ndarray, y: np.ndarray, w: np.ndarray, plain: Alignment, draws: torch.Generator) -> Alignment:
    """M-estimation from a consensus; `plain` where the sample has none."""
    result, share = _consensus(x, y, w, draws) or (plain, 1.0)
    for _ in range(REWEIGHTINGS):
        error = np.abs(y - result.apply(x))
        spread = 1.4826 * np.quantile(error, 0.5 * share)  # the median of those that agree
        if spread <= 1e-12 * np.abs(y).max():
            agree = error <= 1e-9 * np.abs(y).max()  # to rounding: nothing to weigh
            fixes = np.ptp(x[agree]) > LEAST_SPREAD * np.abs(x[agree]).max()
            return _weighted_line(x[agree], y[agree], w[agree]) if fixes else result
        updated = _weighted_line(x, y, w * trusted(error, spread))
        moved = np.abs(updated.apply(x) - result.apply(x)).max()
        result = updated
        if moved < 1e-9 * np.abs(y).max():
            break
    return result


def trusted(error: np.ndarray, spread: float) -> np.ndarray:
    """Geman-McClure weights in (0, 1] of absolute residuals whose standard deviation is `spread` > 0."""
    return (1.0 + (error / (2.0 * spread)) ** 2) ** -2


def _consensus(x: np.ndarray, y: np.ndarray, w: np.ndarray, draws: torch.Generator) -> tuple[Alignment, float] | None:
    """The line through two pixels, of many drawn, whose support chance explains least, and its share of the pixels.

    A contrario, so that no noise level need be known: if x said nothing of y, and a share q of the residuals to
    shuffled targets is within r, h of n would be with probability exp(-n KL(h/n || q)) (Chernoff). The line and the r
    of the largest exponent win; None where no line says more than chance.
    """
    uniform = lambda count: torch.rand(count, generator=draws, dtype=torch.float64).numpy()
    edges = np.cumsum(w) / w.sum()
    first, second = (np.minimum(np.searchsorted(edges, uniform(TRIALS)), x.size - 1) for _ in range(2))
    jury = np.argsort(-np.log1p(-uniform(x.size)) / w)[:JURY]  # by weight, no pixel twice
    run = x[second] - x[first]
    apart = np.abs(run) > LEAST_SPREAD * np.abs(x).max()
    if not apart.any():
        return None
    first, slope = first[apart], (y[second] - y[first])[apart] / run[apart]
    along = y[first, None] + slope[:, None] * (x[jury] - x[first, None])
    error = np.sort(np.abs(y[jury] - along), 1)
    shuffled = np.abs(y[jury][np.argsort(uniform(len(jury)))] - along)
    support = np.unique(np.geomspace(3, len(jury), SUPPORTS).round().astype(int))
    share = (support - 2) / (len(jury) - 2)  # two agree by construction
    within = np.stack([(shuffled <= error[:, s - 1, None]).sum(1) for s in support], 1)
    chance = (within + 1) / (len(jury) + 1)
    rest = np.log(np.maximum(1.0 - share, 1e-12) / np.maximum(1.0 - chance, 1e-12))
    surprise = np.where(share > chance, share * np.log(share / chance) + (1.0 - share) * rest, 0.0)
    if not surprise.any():
        return None
    trial, level = np.unravel_index(surprise.argmax(), surprise.shape)
    offset = y[first[trial]] - slope[trial] * x[first[trial]]
    line = Alignment(float(slope[trial]), float(offset), float(error[trial, support[level] - 1]))
    return line, float(support[level] / len(jury))


def _weighted_line(x: np.ndarray, y: np.ndarray, w: np.ndarray) -> Alignment:
    total = w.sum()
    x_mean, y_mean = (w @ x) / total, (w @ y) / total
    dx, dy = x - x_mean, y - y_mean
    spread = np.sqrt((w @ dx**2) / total)
    _refuse_constant(x, x_mean, spread)
    scale = (w @ (dx / spread * dy)) / total / spread
    residual = np.sqrt((w @ (dy - scale * dx) ** 2) / total)
    return Alignment(float(scale), float(y_mean - scale * x_mean), float(residual))


def _refuse_constant(x: np.ndarray, mean: float, spread: float) -> None:
    if spread <= LEAST_SPREAD * np.abs(x).max():
        raise Degenerate(
            "constant",
            f"alignment is degenerate: the estimate is constant ({mean:.6g}) on its {x.size} known pixels, "
            "which fixes no scale",
        )


def align_depth(
    estimate: np.ndarray, depth: np.ndarray, known: np.ndarray, *, space: Space = "disparity", robust: bool = False
) -> np.ndarray:
    """A monocular estimate brought to the scene's depth, [H, W] float64 camera z.

    PAPER leaves open: whether scale and offset act on depth or on its inverse. Both are here: it must be the space of
    the estimator's output (Depth Anything gives disparity), since an offset in one is no offset in the other.

    Args:
        estimate: [H, W], affine in the scene's depth or in its disparity, as `space` says.
        depth: [H, W] the scene's depth, read where `known`.
        known: bool or weights [H, W]; pixels of depth <= 0 do not count.
        space: what the estimate is affine in.
        robust: see `align`.

    Returns:
        depth; where the aligned disparity is not positive (beyond infinity), the largest depth among known pixels.

    Raises:
        ValueError: as `align`; or the fitted scale is not positive, i.e. the estimate is of the other space.
    """
    depth = np.asarray(depth, np.float64)
    weights = np.asarray(known, np.float64) * (depth > 0)
    target = depth if space == "depth" else geometry.reciprocal(depth)
    fitted = align(estimate, target, weights, robust=robust)
    known_values = np.asarray(estimate, np.float64)[weights > 0]
    rise = fitted.scale * np.ptp(known_values)  # none, to rounding, where the scene's depth is constant: it stays so
    if rise < -1e-12 * target.max():
        other = "depth" if space == "disparity" else "disparity"
        raise ValueError(f"the estimate falls where the scene's {space} grows: is it {other}?")
    aligned, farthest = fitted.apply(estimate), depth[weights > 0].max()
    if space == "depth":
        nearest = depth[weights > 0].min()
        return np.where(aligned > 0, aligned, nearest)
    return np.divide(1.0, aligned, out=np.full(aligned.shape, farthest), where=aligned > 1.0 / (1e3 * farthest))


def align_either(estimate: np.ndarray, depth: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, Space]:
    """A depth map of unknown kind brought to the scene's: (depth [H, W] float64 camera z, what the map is affine in).

    It is taken as depth and as disparity, each with a scale and an offset, robustly; of the two that rise with the
    scene's the one that comes nearer in disparity is kept. One that is in the scene's unit stays as it is, if it fits
    hardly worse, or within `BY_CHANCE`: two such maps agree with each other, while each fitted by itself would be off
    by its own noise.

    Args:
        estimate: [H, W], depth or disparity of any scale and offset; NaN where it says nothing.
        depth: [H, W] the scene's depth, read where `known`.
        known: bool or weights [H, W]; pixels of depth <= 0 do not count.

    Returns:
        depth, NaN where the estimate is; beyond infinity the largest, before the camera the smallest known depth.

    Raises:
        Degenerate: too few known pixels, or a map that is constant there.
        ValueError: the map falls where the scene's depth and disparity grow, or agrees with neither.
    """
    said = np.isfinite(estimate)
    estimate, depth = np.where(said, estimate, 0.0).astype(np.float64), np.asarray(depth, np.float64)
    weights = np.asarray(known, np.float64) * (depth > 0) * said
    shown = weights > 0
    found: dict[Space, tuple[float, np.ndarray]] = {}
    for space in ("disparity", "depth"):
        try:
            aligned = align_depth(estimate, depth, weights, space=space, robust=True)
        except Degenerate:
            raise
        except ValueError:
            continue
        found[space] = (float(np.median(np.abs(1 / aligned[shown] - 1 / depth[shown]))), aligned)
    if not found:
        raise ValueError("the depth map falls where the scene's depth grows, and where its disparity does; invert it")
    space = min(found, key=lambda each: found[each][0])
    error, aligned = found[space]
    disparity = 1 / depth[shown]
    spread = float(np.median(np.abs(disparity - np.median(disparity))))
    if error > DISAGREES * max(spread, LEAST_DISPARITY * float(np.median(disparity))):
        raise ValueError(
            f"the depth map does not fit what is seen: half of it misses by {error / np.median(disparity):.0%} of the "
            f"disparity or more, and the scene's own varies by {spread / np.median(disparity):.0%}"
        )
    given = estimate[shown]
    off = float(np.median(np.abs(geometry.reciprocal(given) - disparity)))
    if (estimate[said] > 0).all() and off <= max(AS_IT_IS * error, BY_CHANCE * float(np.median(disparity))):
        return np.where(said, estimate, np.nan), "depth"
    return np.where(said, aligned, np.nan), space
