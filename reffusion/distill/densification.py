"""Densification in the stage `distill`: masked Gaussians with the largest gradients are cloned or split."""

from __future__ import annotations

import torch

from reffusion.gaussians.densify import densify, prune
from reffusion.gaussians.optimize import GaussianOptimizer

GROW_SCALE3D = 0.01  # standard deviation above which a Gaussian is split, not cloned; in units of the scene
DENSIFIED_SHARE = 0.05  # share of the masked Gaussians that is cloned or split each time
CAP_MAX = 2_000_000  # the largest number of Gaussians
PRUNE_OPA = 0.005  # opacity below which Gaussians are pruned after each densification


def densify_masked(optimizer: GaussianOptimizer, generator: torch.Generator) -> None:
    """Clone or split the masked Gaussians with the largest screen-space gradients, then prune faint Gaussians.

    The share `DENSIFIED_SHARE` of the masked Gaussians is cloned or split, or fewer if fewer have a gradient. All
    Gaussians, masked or not, whose opacity is below `PRUNE_OPA` are pruned. Without masked Gaussians nothing is done,
    not even pruning. Unmasked Gaussians are never cloned or split, because the optimizer accumulates screen-space
    gradients of masked Gaussians only.

    Args:
        optimizer: Holds the Gaussians, which are replaced, and their accumulated screen-space gradients, which are
            reset.
        generator: Draws the positions of split Gaussians.
    """
    if not optimizer.masked.any():
        return
    gradients = (optimizer.grad2d_sum / optimizer.grad2d_count.clamp(min=1))[optimizer.masked]
    threshold = float(gradients.kthvalue(max(1, round((1 - DENSIFIED_SHARE) * len(gradients)))).values)
    threshold = max(threshold, torch.finfo(gradients.dtype).tiny)  # a Gaussian without any gradient is not densified
    densify(optimizer, threshold, GROW_SCALE3D, CAP_MAX, generator)
    prune(optimizer, PRUNE_OPA, float("inf"))
