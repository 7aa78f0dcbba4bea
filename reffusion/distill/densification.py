"""Densification under distillation: the masked Gaussians with the largest gradients are cloned or split."""

from __future__ import annotations

import torch

from reffusion.gaussians.densify import densify, prune
from reffusion.gaussians.optimize import GaussianOptimizer

GROW_SCALE3D = 0.01  # standard deviation from which a Gaussian is split rather than cloned, units of the scene
DENSIFIED_SHARE = 0.05  # of the masked Gaussians, each time
CAP_MAX = 2_000_000  # the largest number of Gaussians
PRUNE_OPA = 0.005  # opacity below which Gaussians are pruned when others are added


def densify_masked(optimizer: GaussianOptimizer, generator: torch.Generator) -> None:
    """Clones or splits the `DENSIFIED_SHARE` of masked Gaussians with the largest screen-space gradients, then prunes
    every Gaussian, masked or not, of an opacity below `PRUNE_OPA`.

    Only masked Gaussians grow, because the optimiser accumulates screen-space gradients of these alone.

    Args:
        generator: draws the positions of split Gaussians.
    """
    if not optimizer.masked.any():
        return
    gradients = (optimizer.grad2d_sum / optimizer.grad2d_count.clamp(min=1))[optimizer.masked]
    threshold = float(gradients.kthvalue(max(1, round((1 - DENSIFIED_SHARE) * len(gradients)))).values)
    threshold = max(threshold, torch.finfo(gradients.dtype).tiny)  # a Gaussian without any gradient is not densified
    densify(optimizer, threshold, GROW_SCALE3D, CAP_MAX, generator)
    prune(optimizer, PRUNE_OPA, float("inf"))
