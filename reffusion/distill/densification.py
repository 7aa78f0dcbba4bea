"""Densification in the stage `distill`: masked Gaussians with large gradients are cloned or split."""

from __future__ import annotations

import torch

from reffusion.gaussians.densify import densify, prune
from reffusion.gaussians.optimize import GaussianOptimizer
from reffusion.params.distill import Densify

GROW_SCALE3D = 0.01  # standard deviation above which a Gaussian is split, not cloned; in `size_unit`
CAP_MAX = 2_000_000  # the largest number of Gaussians
PRUNE_OPA = 0.005  # opacity below which Gaussians are pruned after each densification


def densify_masked(
    optimizer: GaussianOptimizer, started_with: int, settings: Densify, size_unit: float, generator: torch.Generator
) -> None:
    """Clone or split the masked Gaussians with large screen-space gradients, then prune faint Gaussians.

    All Gaussians, masked or not, whose opacity is below `PRUNE_OPA` are pruned. Without masked Gaussians nothing is
    done, not even pruning. Unmasked Gaussians are never cloned or split, because the optimizer accumulates screen-space
    gradients of masked Gaussians only.

    Args:
        optimizer: Holds the Gaussians, which are replaced, and their accumulated screen-space gradients, which are
            reset.
        started_with: Number of masked Gaussians at the start of the distillation, which bounds their growth.
        settings: The threshold and the bound.
        size_unit: The unit of sizes, in the normalized frame.
        generator: Draws the positions of split Gaussians.
    """
    masked = int(optimizer.masked.sum())
    if not masked:
        return
    room = max(0, round(settings.max_growth * started_with) - masked)
    cap_max = min(CAP_MAX, len(optimizer.masked) + room)
    densify(optimizer, settings.grow_grad2d, GROW_SCALE3D * size_unit, cap_max, generator)
    prune(optimizer, PRUNE_OPA, float("inf"))
