"""Random Gaussians in the region of a hole: the initialization without a reference, for an ablation and a baseline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from reffusion.fit.start import initial_gaussians
from reffusion.masks.voting import points_inside
from reffusion.types import Camera, Gaussians

TRIM = 0.02  # share of the removed Gaussians that are ignored at each end of an axis: strays must not stretch the box
MARGIN = 0.1  # share of the box's extent that is added on each side: the surface to be found lies behind the object
MAX_ROUNDS = 200  # rounds of sampling; after the last one, fewer points than asked for are accepted

Box = tuple[np.ndarray, np.ndarray]  # lowest and highest corner, [3] each


def bounding_box(means: np.ndarray) -> Box:
    """Return the axis-aligned box around most of the positions [N, 3], enlarged by 10 % of its extent on each side.

    On each axis the outermost 2 % of the positions at either end are ignored.
    """
    low, high = np.quantile(means, (TRIM, 1 - TRIM), axis=0)
    margin = MARGIN * np.maximum(high - low, 1e-6)
    return low - margin, high + margin


def box_at(center: Sequence[float], size: Sequence[float]) -> Box:
    """Return the axis-aligned box with this center and these side lengths."""
    return np.asarray(center) - np.asarray(size) / 2, np.asarray(center) + np.asarray(size) / 2


def sample_points(
    box: Box, count: int, cameras: Sequence[Camera], holes: Mapping[str, np.ndarray], generator: torch.Generator
) -> np.ndarray:
    """Draw points uniformly in the part of a box that projects into the holes of the views.

    A point is kept if more than half of the views that have a hole and whose image contains the point show it inside
    the hole.

    PAPER leaves open: how many random Gaussians its ablation starts from, and where.

    Args:
        box: lowest and highest corner.
        count: the number of points to draw.
        cameras: the training views.
        holes: view name -> bool [H, W], the invent mask I (the pixels to be invented) of the views that have one.
        generator: draws the points.

    Returns:
        [count, 3] float64; fewer points, at least 4, if `MAX_ROUNDS` rounds do not find `count`.

    Raises:
        ValueError: fewer than 4 points are found.
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
    """Return isotropic Gaussians of random colors at the points, with the sizes and opacity that 3DGS starts with.

    Args:
        points: [N, 3], N at least 4.
        sh_count: number of spherical harmonic coefficients of a Gaussian, (degree + 1)^2.
        antialiased: whether the Gaussians are meant for Mip-Splatting's 2D filter, see `types.Gaussians`.
        generator: draws the colors; its state changes.
    """
    colors = torch.randint(256, (len(points), 3), generator=generator, dtype=torch.uint8).numpy()
    degree = round(sh_count**0.5) - 1
    return replace(initial_gaussians(points, colors, degree, len(points), generator), antialiased=antialiased)
