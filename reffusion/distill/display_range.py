"""The limitation of rendered colors to the range of an 8-bit image."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def clamp_to_display(color: Tensor) -> Tensor:
    """Clamp colors to [0, 1]. The gradient passes unless a step against it would move a color further out of [0, 1].

    PAPER leaves open: colors above 1. Spherical harmonics can produce them, and neither the prior nor the critic was
    trained on such colors. A plain clamp has no gradient there, so such colors would never return. If every gradient
    passed, white could grow without limit.
    """
    return _ClampToDisplay.apply(color)


class _ClampToDisplay(torch.autograd.Function):
    """Autograd function of `clamp_to_display`."""

    @staticmethod
    def forward(ctx, color: Tensor) -> Tensor:
        ctx.save_for_backward(color)
        return color.clamp(0, 1)

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor) -> Tensor:
        (color,) = ctx.saved_tensors
        outwards = ((color > 1) & (gradient < 0)) | ((color < 0) & (gradient > 0))
        return torch.where(outwards, 0.0, gradient)
