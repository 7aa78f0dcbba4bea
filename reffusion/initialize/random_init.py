"""Random Gaussians in the region of a hole: the start without a reference (an ablation, and a baseline's)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from reffusion.fit.start import initial_gaussians
from reffusion.masks.voting import points_inside
from reffusion.types import Camera, Gaussians

FEWEST = 1000
INNER = 0.02  # share of the removed Gaussians left out at each end of an axis: strays must not stretch the box
MARGIN = 0.1  # of the box's extent, on each side: the surface to be found lies behind the object
ROUNDS = 200  # of drawing, before the few points found are taken for all there are

Box = tuple[np.ndarray, np.ndarray]  # lowest and highest corner, [3] each


def box_of(means: np.ndarray) -> Box:
    """The box of these positions [N, 3], without their outermost 2% at each end of an axis, 10% larger on each side."""
    low, high = np.quantile(means, (INNER, 1 - INNER), axis=0)
    margin = MARGIN * np.maximum(high - low, 1e-6)
    return low - margin, high + margin


def box_around(center: Sequence[float], size: Sequence[float]) -> Box:
    """The box with this centre and these sides."""
    return np.asarray(center) - np.asarray(size) / 2, np.asarray(center) + np.asarray(size) / 2


def points_in(
    box: Box, count: int, cameras: Sequence[Camera], holes: Mapping[str, np.ndarray], generator: torch.Generator
) -> np.ndarray:
    """[count, 3] points, uniform in that part of the box which more than half of the views show inside their hole.

    PAPER leaves open: how many random Gaussians its ablation starts from, and where.

    Args:
        holes: view name -> I, bool [H, W]; the views that have one.
    Raises:
        ValueError: hardly any part of the box is seen inside the holes.
    """
    low, high = box
    found = np.zeros((0, 3))
    for _ in range(ROUNDS):
        points = low + torch.rand(count, 3, generator=generator, dtype=torch.float64).numpy() * (high - low)
        found = np.concatenate([found, points[points_inside(points, cameras, holes)]])
        if len(found) >= count:
            return found[:count]
    if len(found) < 4:
        raise ValueError("the box of the hole and the invent masks do not meet: there is no place to start from")
    return found


def gaussians_at(points: np.ndarray, sh_count: int, antialiased: bool, generator: torch.Generator) -> Gaussians:
    """Round Gaussians at the points, sized and faint as 3DGS starts, of random colours; `sh_count` coefficients."""
    colors = torch.randint(256, (len(points), 3), generator=generator, dtype=torch.uint8).numpy()
    degree = round(sh_count**0.5) - 1
    return replace(initial_gaussians(points, colors, degree, len(points), generator), antialiased=antialiased)
