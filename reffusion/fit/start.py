"""The initial Gaussians of a fit: one at each sparse point."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

from reffusion.splat.conventions import SH0
from reffusion.types import Gaussians


def initial_gaussians(
    points: np.ndarray,
    colors: np.ndarray,
    sh_degree: int,
    budget: int,
    generator: torch.Generator,
    opacity: float | np.ndarray = 0.1,
    size: float = 1.0,
) -> Gaussians:
    """Return the initial Gaussians of 3DGS: an isotropic one at each point, as large as the points are far apart.

    Args:
        points: [P, 3] in the normalized frame, P >= 4.
        colors: [P, 3] uint8, the colors of the Gaussians.
        sh_degree: degree of the spherical harmonics; all but the constant one are 0.
        budget: maximum number of Gaussians, at least 4; if there are more points, a random subset of them is used.
        generator: random generator for this subset.
        opacity: opacity of all Gaussians, or [P], that of the Gaussian at each point; in (0, 1).
        size: standard deviation of a Gaussian, divided by the root mean square of the distances from its point to the
            3 nearest other points (of the random subset, if one is used).

    Returns:
        min(P, budget) Gaussians, float32 on the CPU.

    Raises:
        ValueError: there are fewer than 4 points.
    """
    if len(points) < 4:
        raise ValueError(f"a fit starts from sparse points, at least 4; the scene has {len(points)}")
    opacity = np.broadcast_to(np.asarray(opacity, np.float64), len(points))
    if len(points) > budget:
        subset = torch.randperm(len(points), generator=generator)[:budget].numpy()
        points, colors, opacity = points[subset], colors[subset], opacity[subset]
    distance = cKDTree(points).query(points, k=4)[0][:, 1:]
    deviation = size * np.sqrt((distance**2).mean(1)).clip(min=1e-4)
    count = len(points)
    sh = torch.zeros(count, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = (torch.from_numpy(colors.astype(np.float32)) / 255 - 0.5) / SH0
    return Gaussians(
        means=torch.from_numpy(points.astype(np.float32)),
        quaternions=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.from_numpy(np.log(deviation).astype(np.float32))[:, None].repeat(1, 3),
        opacity_logits=torch.from_numpy(np.log(opacity / (1 - opacity)).astype(np.float32)),
        sh=sh,
    )
