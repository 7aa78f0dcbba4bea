"""Alignment of a depth map, plain and robust least squares, over the share of outliers."""

from __future__ import annotations

import numpy as np

from benchmarks.bench.points import Diagram, Point, cpu_seconds
from reffusion import seeding
from reffusion.depth.alignment import align

SIZE = 120 * 160
SHARES = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
NOISE = 0.01  # of the inliers, relative to the map's spread
SEEDS = 5


def make_maps(share: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(estimate, target, truth), [SIZE] each; the truth is affine in the estimate.

    A share of the target is displaced upwards by up to its whole range, as objects in front of a wall displace its
    disparity.
    """
    random = np.random.default_rng(seeding.seed_for(seed, "alignment", share))
    estimate = random.uniform(0.2, 1.0, SIZE)
    truth = 2.5 * estimate + 0.3
    target = truth + NOISE * truth.std() * random.standard_normal(SIZE)
    outliers = random.permutation(SIZE)[: round(share * SIZE)]
    target[outliers] += random.uniform(0.1, 1.0, len(outliers)) * np.ptp(truth)
    return estimate, target, truth


def diagram() -> Diagram:
    points = []
    for curve, robust in (("plain", False), ("robust", True)):
        for share in SHARES:
            errors = []
            for seed in range(SEEDS):
                estimate, target, truth = make_maps(share, seed)
                fitted = align(estimate, target, robust=robust).apply(estimate)
                errors.append(np.sqrt(np.mean((fitted - truth) ** 2)) / truth.std())
            seconds = cpu_seconds(lambda r=robust, e=estimate, t=target: align(e, t, robust=r))
            # The recommendation is for 10 % outliers, which masks cause along an object's border.
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
