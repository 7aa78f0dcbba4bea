"""Cases of the alignment of depth: what fixes no line, outliers, units."""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmarks.stability.cases import EPS64, EXACT, UNCLEAR, Case, largest, unclear
from reffusion.depth import alignment

NOISE = 1e-3  # of the estimate's spread
PIXELS = 2000


def samples(outliers: float, pixels: int = PIXELS, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(estimate, target, truth) of target = 2 estimate + 1, a share of the targets anywhere within their range."""
    random = np.random.default_rng(seed)
    x = random.uniform(1.0, 3.0, pixels)
    truth = 2.0 * x + 1.0
    y = truth + NOISE * random.normal(size=pixels)
    wrong = np.arange(pixels) < round(outliers * pixels)
    return x, np.where(wrong, random.uniform(2.0, 8.0, pixels), y), truth


def robust_error(outliers: float) -> float:
    """Largest error of the robust line over its range and ten scenes, in standard deviations of the noise."""
    worst = 0.0
    for seed in range(10):
        x, y, truth = samples(outliers, seed=seed)
        worst = largest(worst, np.abs(alignment.align(x, y, robust=True, seed=seed).apply(x) - truth).max() / NOISE)
    return float(worst)


def clean_loss() -> float:
    """Without outliers: the robust line against plain L2, over the latter's own standard error at the range's end."""
    x, y, _ = samples(0.0)
    apart = alignment.align(x, y, robust=True).apply(x) - alignment.align(x, y).apply(x)
    return float(np.abs(apart).max() / (NOISE * 2.0 / np.sqrt(len(x))))


def side_by_side() -> float:
    """A third of the pixels lies on a line of its own: the larger group wins; error in standard deviations."""
    x, y, truth = samples(0.0)
    y = np.where(np.arange(len(x)) % 3 == 0, y - truth + 4.0 - 0.5 * x, y)
    return float(np.abs(alignment.align(x, y, robust=True).apply(x) - truth).max() / NOISE)


def unit_error(x_unit: float, y_unit: float, robust: bool) -> float:
    """Relative error of scale and of the aligned values, data without noise in these units."""
    x, _, truth = samples(0.0)
    fitted = alignment.align(x_unit * x, y_unit * truth, robust=robust)
    scale = abs(fitted.scale * x_unit / y_unit / 2.0 - 1.0)
    return float(largest(scale, np.abs(fitted.apply(x_unit * x) / (y_unit * truth) - 1.0).max()))


def far_offset() -> float:
    """An offset of 1e5 spreads in the estimate: error of the aligned values, relative to their spread."""
    x, _, truth = samples(0.0)
    return float(np.abs(alignment.align(x + 5e4, truth).apply(x + 5e4) - truth).max() / np.ptp(truth))


def too_far_offset() -> float:
    """Of 1e8 spreads: an estimate in float32 holds nothing but the offset then."""
    x, _, truth = samples(0.0)
    return unclear(lambda: alignment.align(x + 5e7, truth), "constant")


def constant_depth() -> float:
    """The scene's depth is constant, the estimate is not: a wall. Relative error of the aligned depth."""
    estimate = np.random.default_rng(0).uniform(1.0, 3.0, (12, 10))
    aligned = [
        alignment.align_depth(estimate, np.full((12, 10), 2.5), np.ones((12, 10)), space=space, robust=robust)
        for space in ("depth", "disparity") for robust in (False, True)
    ]  # fmt: skip
    return float(largest(*(np.abs(depth / 2.5 - 1.0).max() for depth in aligned)))


def constant_estimate() -> float:
    flat, depth = np.full((12, 10), 0.7), np.random.default_rng(0).uniform(1.0, 3.0, (12, 10))
    calls = [partial(alignment.align_depth, flat, depth, np.ones((12, 10)), robust=robust) for robust in (False, True)]
    return sum(unclear(call, "constant", "0.7") for call in calls)


def four_pixels(robust: bool) -> float:
    """The least that is taken: exact data, relative error."""
    x = np.array([1.0, 1.5, 2.5, 3.0])
    fitted = alignment.align(x, 2.0 * x + 1.0, robust=robust)
    return float(np.abs(fitted.apply(x) / (2.0 * x + 1.0) - 1.0).max())


def three_pixels() -> float:
    return unclear(lambda: alignment.align(np.arange(3.0), np.arange(3.0)), "at least 4")


def no_pixels() -> float:
    return unclear(lambda: alignment.align_depth(np.ones((3, 3)), np.ones((3, 3)), np.zeros((3, 3))), "at least 4")


def tiny_weights() -> float:
    """Weights of 1e-12 against 1: the line is that of the heavy pixels; relative error."""
    x, y, truth = samples(0.5)
    weights = np.where(np.arange(len(x)) < len(x) // 2, 1e-12, 1.0)
    exact = np.where(weights < 1.0, y, truth)
    return float(np.abs(alignment.align(x, exact, weights).apply(x) / truth - 1.0).max())


def beyond_infinity() -> float:
    """Aligned disparities of zero and below: depths that are not finite and positive."""
    disparity = np.linspace(-0.5, 2.0, 120).reshape(12, 10)
    known = disparity > 0.1
    depth = np.where(known, 1.0 / np.where(known, disparity, 1.0), 0.0)
    found = alignment.align_depth(disparity, depth, known)
    return float((~(np.isfinite(found) & (found > 0))).sum())


def plain_condition() -> float:
    """Condition number of what `align` solves where the estimate stands 1e4 spreads from zero."""
    return alignment.condition(1e4 + np.random.default_rng(0).normal(size=1000))[1]


# A sum over n pixels in float64 rounds by some sqrt(n) 2^-53 of its terms; data of order one, slopes included.
ROUNDED = 8 * np.sqrt(PIXELS) * EPS64
# The line through k inliers has a standard error of at most 2 NOISE / sqrt(k) at the range's ends; six of those hold
# for ten scenes at both ends.
STANDARD = lambda inliers: 6 * 2 / np.sqrt(inliers)

CASES = (
    Case("alignment, constant depth", "relative error of the aligned depth", ROUNDED, constant_depth),
    Case("alignment, constant estimate", UNCLEAR, EXACT, constant_estimate),
    Case("alignment, four pixels", "relative error", 16 * EPS64, partial(four_pixels, False)),
    Case("alignment, four pixels, robust", "relative error", 16 * EPS64, partial(four_pixels, True)),
    Case("alignment, three pixels", UNCLEAR, EXACT, three_pixels),
    Case("alignment, no pixel", UNCLEAR, EXACT, no_pixels),
    *(Case(f"alignment, {share:.0%} outliers", "error of the line in standard deviations of the noise",
           float(STANDARD((1 - share) * PIXELS)), partial(robust_error, share)) for share in (0.3, 0.6, 0.9)),
    # Geman-McClure is 85 to 95% efficient: it differs from L2 by about 0.4 of L2's standard error; four of these.
    Case("alignment, robust without outliers", "difference from L2 in its standard errors", 1.6, clean_loss),
    Case("alignment, a third on another line", "error of the line in standard deviations of the noise",
         float(STANDARD(2 / 3 * PIXELS)), side_by_side),
    *(Case(f"alignment, scale {unit:g}{how}", "relative error", float(ROUNDED), partial(unit_error, *units, robust))
      for unit, units in ((1e-8, (1e8, 1.0)), (1e8, (1e-8, 1.0)), (1e-16, (1e8, 1e-8)), (1e16, (1e-8, 1e8)))
      for how, robust in (("", False), (", robust", True))),
    # The mean is known to 2^-53 of itself: that many spreads of it cost as many digits.
    Case("alignment, offset 1e5 of the spread", "error relative to the spread", float(1e5 * ROUNDED), far_offset),
    Case("alignment, offset 1e8 of the spread", UNCLEAR, EXACT, too_far_offset),
    Case("alignment, weights of 1e-12 and 1", "relative error", 1e-11, tiny_weights),
    Case("alignment beyond infinity", "depths that are not finite and positive", EXACT, beyond_infinity),
    # Two equations that do not know of each other and have equal weight; the mean's rounding is 1e4 * 2^-53.
    Case("alignment, condition of its equations", "condition number", 1.0 + 1e-9, plain_condition),
)  # fmt: skip
