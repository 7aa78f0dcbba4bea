"""Diagram of the alignment of a depth map by plain and by robust least squares, by the share of outliers."""

from __future__ import annotations

import numpy as np

from lab.bench.points import Diagram, Point, cpu_seconds
from reffusion import seeding
from reffusion.depth.alignment import align

SIZE = 120 * 160  # number of pixels
SHARES = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)  # shares of outliers
NOISE = 0.01  # standard deviation of the inliers' noise, relative to that of the map
SEEDS = 5  # number of maps for each share


def make_maps(share: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make a disparity map and its noisy target with outliers.

    Outliers are larger than the truth by a tenth of its range to its whole range, like the disparity of objects in
    front of a wall.

    Args:
        share: share of outliers.
        seed: seed.

    Returns:
        estimate: [SIZE], the map to align.
        target: [SIZE], the truth with noise and outliers.
        truth: [SIZE], an affine function of the estimate.
    """
    random = np.random.default_rng(seeding.seed_for(seed, "alignment", share))
    estimate = random.uniform(0.2, 1.0, SIZE)
    truth = 2.5 * estimate + 0.3
    target = truth + NOISE * truth.std() * random.standard_normal(SIZE)
    outliers = random.permutation(SIZE)[: round(share * SIZE)]
    target[outliers] += random.uniform(0.1, 1.0, len(outliers)) * np.ptp(truth)
    return estimate, target, truth


def diagram() -> Diagram:
    """Measure plain and robust alignment by the share of outliers.

    The error is the RMS difference of the aligned estimate from the truth over the truth's standard deviation, averaged
    over `SEEDS` maps. The time is that of `align`.
    """
    points = []
    for curve, robust in (("plain", False), ("robust", True)):
        for share in SHARES:
            errors = []
            for seed in range(SEEDS):
                estimate, target, truth = make_maps(share, seed)
                fitted = align(estimate, target, robust=robust).apply(estimate)
                errors.append(np.sqrt(np.mean((fitted - truth) ** 2)) / truth.std())
            seconds = cpu_seconds(lambda r=robust, e=estimate, t=target: align(e, t, robust=r))
            # The recommendation is made at 10 % outliers, a share that masks cause along an object's border.
            points.append(Point(curve, f"{share:.0%}", share, float(np.mean(errors)), seconds, share == 0.1))
    why = "At 10 % outliers; without outliers both are equally good, and plain is the paper's L2."
    return Diagram(
        "alignment",
        f"Alignment of {SIZE} pixels, inliers with {NOISE:.0%} noise",
        "RMS error of the aligned map over its spread",
        ("plain", "10%"),
        points,
        over="share of outliers",
        why=why,
    )
