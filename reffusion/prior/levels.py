"""Levels: the brightness and contrast of a picture, as its known pixels have them.

A small model makes errors of a fixed size, which stand out in a picture of low contrast, such as a window of a smooth
wall. So pictures are normalized to the same mean and contrast before such a model sees them, and its outputs are
converted back.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

LEAST_CONTRAST = 0.05  # standard deviation, of a range of 2, below which contrast is not raised further


class Levels(NamedTuple):
    """Brightness and contrast of pictures, relative to those at which a model sees them.

    Attributes:
        mean: [B, 3, 1, 1], the color that the model sees as 0.
        gain: [B, 1, 1, 1], the factor by which differences of color are multiplied for the model.
    """

    mean: Tensor
    gain: Tensor

    def normalize(self, images: Tensor) -> Tensor:
        """Convert images [B, 3, H, W] to the levels of the model; differentiable."""
        return (images - self.mean) * self.gain

    def restore(self, images: Tensor) -> Tensor:
        """Convert images [B, 3, H, W] from the levels of the model to their own."""
        return images / self.gain + self.mean


@torch.no_grad()
def measure_levels(images: Tensor, hidden: Tensor, contrast: float) -> Levels:
    """Return the levels at which the known pixels have mean 0 and the standard deviation `contrast`.

    The gain is limited: if the standard deviation is below `LEAST_CONTRAST`, the result stays below `contrast`. Without
    known pixels, and with a contrast of 0, the levels change nothing (mean 0, gain 1).

    Args:
        images: [B, 3, H, W] in [-1, 1]. Values in the hole are ignored and need not be finite.
        hidden: [B, 1, H, W], 1 = hole, 0 = known.
        contrast: The standard deviation over all pixels and channels, or 0.
    """
    known = (1 - hidden) * (contrast > 0)
    count = known.sum((2, 3), keepdim=True)
    images = torch.where(known > 0, images, 0)
    mean = images.sum((2, 3), keepdim=True) / count.clamp(min=1)
    variance = ((images - mean).square() * known).sum((1, 2, 3), keepdim=True) / (3 * count.clamp(min=1))
    gain = contrast / variance.sqrt().clamp(min=LEAST_CONTRAST)
    return Levels(mean, torch.where(count > 0, gain, 1.0))
