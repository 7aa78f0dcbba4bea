"""Gaussians of simple shapes."""

from __future__ import annotations

import math

import numpy as np
import torch

from reffusion.splat.conventions import SH0
from reffusion.types import Gaussians


def round_gaussians(
    means: np.ndarray | torch.Tensor,
    colors: np.ndarray | torch.Tensor,
    size: float,
    opacity_logit: float,
    sh_count: int = 1,
) -> Gaussians:
    """Return round Gaussians of the same size and opacity.

    Args:
        means: [N, 3].
        colors: [N, 3] in [0, 1], the same in all directions.
        sh_count: number of spherical harmonics of each channel.
    """
    means, colors = (torch.as_tensor(np.asarray(each), dtype=torch.float32) for each in (means, colors))
    count = len(means)
    sh = torch.zeros(count, sh_count, 3)
    sh[:, 0] = (colors - 0.5) / SH0
    turns = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    return Gaussians(means, turns, torch.full((count, 3), math.log(size)), torch.full((count,), opacity_logit), sh)


def join_gaussians(first: Gaussians, second: Gaussians) -> Gaussians:
    """Return the Gaussians of both sets, those of `first` first."""
    return first.zip_map(second, lambda a, b: torch.cat([a, b]))
