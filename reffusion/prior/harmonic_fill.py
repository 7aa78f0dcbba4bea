"""A hole's first guess: the harmonic extension of its surroundings, what a soap film over the hole would show."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

SWEEPS = 4  # of Jacobi's iteration a level: 0.15 dB short of the exact extension on 64 held-out holes, for 1 ms each


@torch.no_grad()
def extended(images: Tensor, hidden: Tensor) -> Tensor:
    """`images` with every hole filled by the harmonic extension of what is given, by cascadic multigrid.

    From the coarsest grid, a pixel, to the finest: cells in which something is given keep its mean, the others take
    the coarser grid's answer and `SWEEPS` of Jacobi's iteration, the picture's edge being insulated.

    Args:
        images: [B, C, H, W]; what lies under `hidden` does not matter, and may not be finite.
        hidden: [B, 1, H, W], 1 = hole, 0 = given.

    Returns:
        [B, C, H, W], of the values' range; 0 all over where nothing is given. Carries no gradient.
    """
    given = 1 - hidden
    grids = [(torch.where(hidden > 0.5, 0, images), given)]
    while max(grids[-1][0].shape[-2:]) > 1:
        grids.append(tuple(_halved(part) for part in grids[-1]))
    total, share = grids.pop()
    filled = total / share.clamp(min=torch.finfo(images.dtype).tiny)
    for total, share in reversed(grids):
        empty = share == 0
        coarse = F.interpolate(filled, size=total.shape[-2:], mode="bilinear")
        filled = torch.where(empty, coarse, total / torch.where(empty, 1, share))
        for _ in range(SWEEPS):
            filled = torch.where(empty, _neighbours(filled), filled)
    return filled


def _halved(part: Tensor) -> Tensor:
    """Means of 2 x 2 pixels; an odd side is filled up with zeros, which weigh nothing."""
    height, width = part.shape[-2:]
    return F.avg_pool2d(F.pad(part, (0, width % 2, 0, height % 2)), 2)


def _neighbours(x: Tensor) -> Tensor:
    """The mean of a pixel's four neighbours; beyond the edge stands the pixel itself."""
    p = F.pad(x, (1, 1, 1, 1), mode="replicate")
    return (p[..., :-2, 1:-1] + p[..., 2:, 1:-1] + p[..., 1:-1, :-2] + p[..., 1:-1, 2:]) / 4
