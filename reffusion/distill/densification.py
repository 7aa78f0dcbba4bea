"""Densification in the stage `distill`: masked Gaussians with large gradients are cloned or split."""

from __future__ import annotations

import torch

from reffusion.gaussians.densify import PRUNED_OPACITY, SPLIT_SCALE, densify, prune
from reffusion.gaussians.optimize import GaussianOptimizer
from reffusion.params.distill import Densify

CAP_MAX = 2_000_000  # the largest number of Gaussians


def densify_masked(
    optimizer: GaussianOptimizer, started_with: int, settings: Densify, size_unit: float, generator: torch.Generator
) -> None:
    """Clone or split the masked Gaussians with large screen-space gradients, then prune faint Gaussians.

    All Gaussians, masked or not, whose opacity is below `PRUNED_OPACITY` are pruned. Without masked Gaussians nothing
    is done, not even pruning. Unmasked Gaussians are never cloned or split, because the optimizer accumulates
    screen-space gradients of masked Gaussians only.

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
    densify(optimizer, settings.grow_grad2d, SPLIT_SCALE * size_unit, cap_max, generator)
    prune(optimizer, PRUNED_OPACITY, float("inf"))
