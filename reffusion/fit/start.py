"""The initial Gaussians of a fit: one at each point."""

from __future__ import annotations

import math

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
    opacity: float = 0.1,
    size: float = 1.0,
) -> Gaussians:
    """Initialization of 3DGS: an isotropic Gaussian at each point, scaled by the distance to its 3 nearest neighbours.

    Args:
        points: [P, 3] in the normalised frame, P >= 4.
        colors: [P, 3] uint8.
        budget: maximum number of Gaussians; above it a random subset of the points is used.
        generator: of that subset.
        opacity: of each Gaussian, in (0, 1).
        size: standard deviation divided by the root mean square of the distances to the neighbours.

    Raises:
        ValueError: fewer than 4 points.
    """
    if len(points) < 4:
        raise ValueError(f"a fit starts from sparse points, at least 4; the scene has {len(points)}")
    if len(points) > budget:
        subset = torch.randperm(len(points), generator=generator)[:budget].numpy()
        points, colors = points[subset], colors[subset]
    distance = cKDTree(points).query(points, k=4)[0][:, 1:]
    deviation = size * np.sqrt((distance**2).mean(1)).clip(min=1e-4)
    count = len(points)
    sh = torch.zeros(count, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = (torch.from_numpy(colors.astype(np.float32)) / 255 - 0.5) / SH0
    return Gaussians(
        means=torch.from_numpy(points.astype(np.float32)),
        quaternions=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.from_numpy(np.log(deviation).astype(np.float32))[:, None].repeat(1, 3),
        opacity_logits=torch.full((count,), math.log(opacity / (1 - opacity))),
        sh=sh,
    )
