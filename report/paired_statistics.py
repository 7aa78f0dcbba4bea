"""Is a method better than another? Paired differences with their intervals, and who is on the Pareto front."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

LEVEL = 0.95


@dataclass(frozen=True)
class Difference:
    """How far one method lies from another in a metric.

    Attributes:
        mean: over all pairs.
        pairs: how many.
        views: half the width of its 95% interval, the paired t over views times scenes: holds for these scenes.
            None under two pairs.
        scenes: the same over the means of the scenes: for another scene of their kind. None under two scenes.
    """

    mean: float
    pairs: int
    views: float | None
    scenes: float | None


def paired_difference(differences: Sequence[np.ndarray]) -> Difference | None:
    """`differences`: one array [views] a scene, method minus the other, same views. None where there is no pair."""
    scenes = [np.asarray(d, np.float64) for d in differences if len(d)]
    if not scenes:
        return None
    pairs, means = np.concatenate(scenes), np.array([d.mean() for d in scenes])
    return Difference(float(pairs.mean()), len(pairs), confidence_half_width(pairs), confidence_half_width(means))


def confidence_half_width(values: np.ndarray) -> float | None:
    """Of Student's interval of the mean of [n] independent values; None under two."""
    if len(values) < 2:
        return None
    from scipy.stats import t

    return float(t.ppf((1 + LEVEL) / 2, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))


def pareto_front(seconds: Sequence[float], errors: Sequence[float]) -> np.ndarray:
    """bool [n]: no other point is as fast and as good, and better in one of the two. Equal points stay together."""
    front = np.zeros(len(seconds), bool)
    best = np.inf  # the least error among all faster points
    points = np.column_stack([seconds, errors]).reshape(-1, 2)
    for moment in np.unique(points[:, 0]):
        at = np.flatnonzero(points[:, 0] == moment)
        least = points[at, 1].min()
        if least < best:
            front[at[points[at, 1] == least]] = True
            best = least
    return front
