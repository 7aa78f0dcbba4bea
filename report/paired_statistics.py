"""Paired differences between methods with confidence intervals, and the Pareto front."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

LEVEL = 0.95  # of confidence


@dataclass(frozen=True)
class Difference:
    """Difference of a first method to a second one (first minus second) in a metric, on pairs of renders of one view.

    Attributes:
        mean: mean difference over all pairs, in units of the metric.
        pairs: number of pairs.
        views: half the width of the 95% confidence interval of the mean, from a paired t-test over the views of all
            scenes. This interval is valid for these scenes only. None for fewer than two pairs.
        scenes: half the width of the 95% confidence interval of the mean of the scenes' means, from a paired t-test
            over one mean per scene. This interval is valid for other scenes of the same kind too. None for fewer than
            two scenes.
        scenes_mean: mean of the scenes' means, the center of the interval over scenes. It equals `mean` if all scenes
            have equally many pairs.
    """

    mean: float
    pairs: int
    views: float | None
    scenes: float | None
    scenes_mean: float


def paired_difference(differences: Sequence[np.ndarray]) -> Difference | None:
    """Return the mean difference over all pairs with its confidence intervals, or None if there are no pairs.

    Args:
        differences: one array [views] per scene: the metric of the first method minus the metric of the second method,
            for each view. Empty arrays are ignored.
    """
    scenes = [np.asarray(d, np.float64) for d in differences if len(d)]
    if not scenes:
        return None
    pairs, means = np.concatenate(scenes), np.array([d.mean() for d in scenes])
    widths = confidence_half_width(pairs), confidence_half_width(means)
    return Difference(float(pairs.mean()), len(pairs), *widths, float(means.mean()))


def confidence_half_width(values: np.ndarray) -> float | None:
    """Return half the width of Student's 95% confidence interval of the mean of `values` [n]; None for n < 2.

    The values are taken as independent.
    """
    if len(values) < 2:
        return None
    from scipy.stats import t

    return float(t.ppf((1 + LEVEL) / 2, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))


def pareto_front(seconds: Sequence[float], errors: Sequence[float]) -> np.ndarray:
    """Return bool [n], True for the points on the Pareto front of run time and error.

    A point is on the front unless another point is at least as fast and at least as good, and better in one of the two.
    Equal points are on the front together.

    Args:
        seconds: [n] run times.
        errors: [n] errors; less is better.
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
