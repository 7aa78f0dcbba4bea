"""Alignment of a depth map, plain least squares against the robust one, over the share of outliers."""

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
    """(estimate, target, truth), [SIZE] each: truth is affine in the estimate; a share of the target is displaced by up
    to its whole range, upwards, as things in front of a wall displace its disparity."""
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
            # What is recommended is the way, at a share of outliers that masks at an object's rim bring about.
            points.append(Point(curve, f"{share:.0%}", share, float(np.mean(errors)), seconds, share == 0.1))
    why = "At 10 % outliers; without any both are equally good, and plain is what the paper's L2 says."
    return Diagram(
        "alignment",
        f"Alignment of {SIZE} pixels, inliers with {NOISE:.0%} noise",
        "RMS error of the aligned map over its spread",
        ("plain", "10%"),
        points,
        over="share of outliers",
        why=why,
    )
