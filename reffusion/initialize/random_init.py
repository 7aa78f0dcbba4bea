"""Random Gaussians in the region of a hole: the initialization without a reference (an ablation, and a baseline's)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from reffusion.fit.start import initial_gaussians
from reffusion.masks.voting import points_inside
from reffusion.types import Camera, Gaussians

MIN_GAUSSIANS = 1000
TRIM = 0.02  # share of the removed Gaussians that are ignored at each end of an axis: strays must not stretch the box
MARGIN = 0.1  # of the box's extent, on each side: the surface to be found lies behind the object
MAX_ROUNDS = 200  # of sampling, after which the few points found must do

Box = tuple[np.ndarray, np.ndarray]  # lowest and highest corner, [3] each


def bounding_box(means: np.ndarray) -> Box:
    """The box of these positions [N, 3] without the outermost 2 % at each end of an axis, 10 % larger on each side."""
    low, high = np.quantile(means, (TRIM, 1 - TRIM), axis=0)
    margin = MARGIN * np.maximum(high - low, 1e-6)
    return low - margin, high + margin


def box_at(center: Sequence[float], size: Sequence[float]) -> Box:
    """The box with this centre and these side lengths."""
    return np.asarray(center) - np.asarray(size) / 2, np.asarray(center) + np.asarray(size) / 2


def sample_points(
    box: Box, count: int, cameras: Sequence[Camera], holes: Mapping[str, np.ndarray], generator: torch.Generator
) -> np.ndarray:
    """[count, 3] points, uniform in the part of the box that more than half of the views show inside their hole.

    PAPER leaves open: how many random Gaussians its ablation starts from, and where.

    Args:
        holes: view name -> I, bool [H, W], of the views that have one.
    Raises:
        ValueError: hardly any part of the box is visible inside the holes.
    """
    low, high = box
    found = np.zeros((0, 3))
    for _ in range(MAX_ROUNDS):
        points = low + torch.rand(count, 3, generator=generator, dtype=torch.float64).numpy() * (high - low)
        found = np.concatenate([found, points[points_inside(points, cameras, holes)]])
        if len(found) >= count:
            return found[:count]
    if len(found) < 4:
        raise ValueError("the box of the hole and the invent masks do not meet: there is no place to start from")
    return found


def random_gaussians(points: np.ndarray, sh_count: int, antialiased: bool, generator: torch.Generator) -> Gaussians:
    """Round Gaussians at the points, of random colours, sized and faint as 3DGS's initial ones.

    Args:
        sh_count: spherical harmonic coefficients of each.
    """
    colors = torch.randint(256, (len(points), 3), generator=generator, dtype=torch.uint8).numpy()
    degree = round(sh_count**0.5) - 1
    return replace(initial_gaussians(points, colors, degree, len(points), generator), antialiased=antialiased)
