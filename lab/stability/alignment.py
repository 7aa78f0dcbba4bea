"""Cases of depth alignment: degenerate data, outliers, units.

Alignment fits scale and offset of an estimate to a target. The data have a known exact line, target = 2 estimate + 1.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from lab.stability.cases import EPS64, EXACT, UNCLEAR, Case, count_unclear_refusal, nan_safe_max
from lab.studies.conditioning import alignment_conditions
from reffusion.depth import alignment

NOISE = 1e-3  # standard deviation of the target's noise
PIXELS = 2000


def make_samples(outliers: float, pixels: int = PIXELS, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw samples with outliers, which come first.

    Args:
        outliers: share of outliers, 0 to 1. An outlier's target is uniform over the range from 2 to 8.
        pixels: number of samples.
        seed: seed.

    Returns:
        estimate: [pixels].
        target: [pixels], the truth with noise, or an outlier.
        truth: [pixels], 2 estimate + 1, of outliers too.
    """
    random = np.random.default_rng(seed)
    x = random.uniform(1.0, 3.0, pixels)
    truth = 2.0 * x + 1.0
    y = truth + NOISE * random.normal(size=pixels)
    wrong = np.arange(pixels) < round(outliers * pixels)
    return x, np.where(wrong, random.uniform(2.0, 8.0, pixels), y), truth


def robust_error(outliers: float) -> float:
    """Return the largest error of the robustly aligned estimate over all samples of ten draws.

    The unit is the standard deviation of the noise.
    """
    worst = 0.0
    for seed in range(10):
        x, y, truth = make_samples(outliers, seed=seed)
        worst = nan_safe_max(
            worst, np.abs(alignment.align(x, y, robust=True, seed=seed).apply(x) - truth).max() / NOISE
        )
    return float(worst)


def robust_difference() -> float:
    """Return the largest difference between the robustly and the plainly aligned estimate if there are no outliers.

    The unit is the standard error of plain least squares at the ends of the estimate's range.
    """
    x, y, _ = make_samples(0.0)
    difference = alignment.align(x, y, robust=True).apply(x) - alignment.align(x, y).apply(x)
    return float(np.abs(difference).max() / (NOISE * 2.0 / np.sqrt(len(x))))


def two_lines_error() -> float:
    """Return the largest error of the robustly aligned estimate, in standard deviations of the noise, for two lines.

    A third of the samples is on another line. The fit must follow the larger group, whose line is the truth.
    """
    x, y, truth = make_samples(0.0)
    y = np.where(np.arange(len(x)) % 3 == 0, y - truth + 4.0 - 0.5 * x, y)
    return float(np.abs(alignment.align(x, y, robust=True).apply(x) - truth).max() / NOISE)


def unit_error(x_unit: float, y_unit: float, robust: bool) -> float:
    """Return the largest relative error of the scale and of the aligned values for data without noise.

    Args:
        x_unit: factor on the estimate.
        y_unit: factor on the target.
        robust: True for the robust fit.
    """
    x, _, truth = make_samples(0.0)
    fitted = alignment.align(x_unit * x, y_unit * truth, robust=robust)
    scale = abs(fitted.scale * x_unit / y_unit / 2.0 - 1.0)
    return float(nan_safe_max(scale, np.abs(fitted.apply(x_unit * x) / (y_unit * truth) - 1.0).max()))


def offset_error() -> float:
    """Return the largest error of the aligned values, relative to the truth's range, for an estimate with an offset.

    The offset is about 1e5 times the standard deviation of the estimate.
    """
    x, _, truth = make_samples(0.0)
    return float(np.abs(alignment.align(x + 5e4, truth).apply(x + 5e4) - truth).max() / np.ptp(truth))


def refuse_too_far_offset() -> float:
    """Return 0 if an estimate with an offset of 1e8 standard deviations is refused as constant, else 1.

    In float32 such an estimate would contain nothing but the offset.
    """
    x, _, truth = make_samples(0.0)
    return count_unclear_refusal(lambda: alignment.align(x + 5e7, truth), "constant")


def constant_depth_error() -> float:
    """Return the largest relative error of the aligned depth if the scene's depth is constant (a wall).

    The estimate is not constant. It is aligned as depth and as disparity, by the plain and by the robust fit.
    """
    estimate = np.random.default_rng(0).uniform(1.0, 3.0, (12, 10))
    aligned = [
        alignment.align_depth(estimate, np.full((12, 10), 2.5), np.ones((12, 10)), space=space, robust=robust)
        for space in ("depth", "disparity") for robust in (False, True)
    ]  # fmt: skip
    return float(nan_safe_max(*(np.abs(depth / 2.5 - 1.0).max() for depth in aligned)))


def refuse_constant_estimate() -> float:
    """Count the fits to a constant estimate, plain and robust, that are not refused with the cause and the value."""
    flat, depth = np.full((12, 10), 0.7), np.random.default_rng(0).uniform(1.0, 3.0, (12, 10))
    calls = [partial(alignment.align_depth, flat, depth, np.ones((12, 10)), robust=robust) for robust in (False, True)]
    return sum(count_unclear_refusal(call, "constant", "0.7") for call in calls)


def four_pixels_error(robust: bool) -> float:
    """Return the largest relative error of a fit to four exact samples, the least accepted number."""
    x = np.array([1.0, 1.5, 2.5, 3.0])
    fitted = alignment.align(x, 2.0 * x + 1.0, robust=robust)
    return float(np.abs(fitted.apply(x) / (2.0 * x + 1.0) - 1.0).max())


def refuse_three_pixels() -> float:
    """Return 0 if a fit to three samples is refused with the cause, else 1."""
    return count_unclear_refusal(lambda: alignment.align(np.arange(3.0), np.arange(3.0)), "at least 4")


def refuse_no_pixels() -> float:
    """Return 0 if an alignment without known pixels is refused with the cause, else 1."""
    return count_unclear_refusal(
        lambda: alignment.align_depth(np.ones((3, 3)), np.ones((3, 3)), np.zeros((3, 3))), "at least 4"
    )


def tiny_weights_error() -> float:
    """Return the largest relative error of a fit to samples of weight 1 among wrong samples of weight 1e-12."""
    x, y, truth = make_samples(0.5)
    weights = np.where(np.arange(len(x)) < len(x) // 2, 1e-12, 1.0)
    exact = np.where(weights < 1.0, y, truth)
    return float(np.abs(alignment.align(x, exact, weights).apply(x) / truth - 1.0).max())


def count_invalid_depths() -> float:
    """Count aligned depths that are not finite and positive; some of the aligned disparities are zero or negative."""
    disparity = np.linspace(-0.5, 2.0, 120).reshape(12, 10)
    known = disparity > 0.1
    depth = np.where(known, 1.0 / np.where(known, disparity, 1.0), 0.0)
    aligned = alignment.align_depth(disparity, depth, known)
    return float((~(np.isfinite(aligned) & (aligned > 0))).sum())


def plain_condition() -> float:
    """Return the condition number of the system that `align` solves if the offset is 1e4 standard deviations."""
    return alignment_conditions(1e4 + np.random.default_rng(0).normal(size=1000))[1]


# A float64 sum over n pixels rounds by about sqrt(n) 2^-53 of its terms; data and slopes are of order one.
ROUNDING = 8 * np.sqrt(PIXELS) * EPS64
# The line through k inliers has a standard error of at most 2 NOISE / sqrt(k) at the ends of the range. Six standard
# errors are a safe bound for ten draws at both ends.
STD_ERRORS = lambda inliers: 6 * 2 / np.sqrt(inliers)

CASES = (
    Case("alignment, constant depth", "relative error of the aligned depth", ROUNDING, constant_depth_error),
    Case("alignment, constant estimate", UNCLEAR, EXACT, refuse_constant_estimate),
    Case("alignment, four pixels", "relative error", 16 * EPS64, partial(four_pixels_error, False)),
    Case("alignment, four pixels, robust", "relative error", 16 * EPS64, partial(four_pixels_error, True)),
    Case("alignment, three pixels", UNCLEAR, EXACT, refuse_three_pixels),
    Case("alignment, no pixel", UNCLEAR, EXACT, refuse_no_pixels),
    *(Case(f"alignment, {share:.0%} outliers", "error of the line in standard deviations of the noise",
           float(STD_ERRORS((1 - share) * PIXELS)), partial(robust_error, share)) for share in (0.3, 0.6, 0.9)),
    # Geman-McClure is 85 to 95% efficient: it differs from L2 by about 0.4 of L2's standard error; four of these.
    Case("alignment, robust without outliers", "difference from L2 in its standard errors", 1.6, robust_difference),
    Case("alignment, a third on another line", "error of the line in standard deviations of the noise",
         float(STD_ERRORS(2 / 3 * PIXELS)), two_lines_error),
    *(Case(f"alignment, scale {unit:g}{how}", "relative error", float(ROUNDING), partial(unit_error, *units, robust))
      for unit, units in ((1e-8, (1e8, 1.0)), (1e8, (1e-8, 1.0)), (1e-16, (1e8, 1e-8)), (1e16, (1e-8, 1e8)))
      for how, robust in (("", False), (", robust", True))),
    # The mean is known to 2^-53 of itself, so an offset of n spreads costs log10(n) digits.
    Case("alignment, offset 1e5 of the spread", "error relative to the spread", float(1e5 * ROUNDING), offset_error),
    Case("alignment, offset 1e8 of the spread", UNCLEAR, EXACT, refuse_too_far_offset),
    Case("alignment, weights of 1e-12 and 1", "relative error", 1e-11, tiny_weights_error),
    Case("alignment beyond infinity", "depths that are not finite and positive", EXACT, count_invalid_depths),
    # Two decoupled equations of equal weight; the mean's rounding is 1e4 * 2^-53.
    Case("alignment, condition of its equations", "condition number", 1.0 + 1e-9, plain_condition),
)  # fmt: skip
