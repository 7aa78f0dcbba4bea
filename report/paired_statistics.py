"""Paired differences between methods with confidence intervals, and the Pareto front."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

LEVEL = 0.95  # of confidence


@dataclass(frozen=True)
class Difference:
    """Difference of one method to another in a metric.

    Attributes:
        mean: over all pairs.
        pairs: how many.
        views: half the width of the 95% interval of the paired t over views of all scenes: holds for these scenes. None
            for fewer than two pairs.
        scenes: the same over the means of the scenes: holds for another scene of their kind. None for fewer than two
            scenes.
    """

    mean: float
    pairs: int
    views: float | None
    scenes: float | None


def paired_difference(differences: Sequence[np.ndarray]) -> Difference | None:
    """Difference over all pairs, or None without pairs.

    `differences` holds one array [views] per scene: method minus the other, on the same views.
    """
    scenes = [np.asarray(d, np.float64) for d in differences if len(d)]
    if not scenes:
        return None
    pairs, means = np.concatenate(scenes), np.array([d.mean() for d in scenes])
    return Difference(float(pairs.mean()), len(pairs), confidence_half_width(pairs), confidence_half_width(means))


def confidence_half_width(values: np.ndarray) -> float | None:
    """Half the width of Student's interval of the mean of [n] independent values; None for n < 2."""
    if len(values) < 2:
        return None
    from scipy.stats import t

    return float(t.ppf((1 + LEVEL) / 2, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))


def pareto_front(seconds: Sequence[float], errors: Sequence[float]) -> np.ndarray:
    """bool [n]: points for which no other is as fast and as good, and better in one of the two.

    Equal points are on the front together.
    """
    front = np.zeros(len(seconds), bool)
    best = np.inf  # least error of all faster points
    points = np.column_stack([seconds, errors]).reshape(-1, 2)
    for moment in np.unique(points[:, 0]):
        at = np.flatnonzero(points[:, 0] == moment)
        least = points[at, 1].min()
        if least < best:
            front[at[points[at, 1] == least]] = True
            best = least
    return front
