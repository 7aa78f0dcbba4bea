"""Windows around masked pixels, and views at two scales: the inputs of SDS and of personalization."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def window_around(mask: Tensor, size: int, generator: torch.Generator) -> tuple[int, int]:
    """Draw a size x size window around a random masked pixel, and return its upper left corner (top, left).

    PAPER leaves open: how a patch is sampled from the bounding box of the mask. The centre of the window is a masked
    pixel, because the box may be mostly unmasked (a ring, two objects). A window that extends beyond the view is moved
    inside.

    Args:
        mask: bool [H, W] with at least one True pixel.
        size: Side of the window in pixels, at most min(H, W).
        generator: The source of randomness, on the CPU.

    Raises:
        ValueError: The window does not fit into the view, or the mask is empty.
    """
    return tuple(windows_around(mask, size, 1, generator)[0].tolist())


def windows_around(mask: Tensor, size: int, count: int, generator: torch.Generator) -> Tensor:
    """Draw `count` independent windows like `window_around`, and return their corners (top, left), long [count, 2].

    Raises:
        ValueError: A window does not fit into the view, or the mask is empty.
    """
    height, width = mask.shape
    if size > min(height, width):
        raise ValueError(f"a window of {size} px does not fit into a view of {width} x {height} px; enlarge it first")
    pixels = torch.nonzero(mask)
    if len(pixels) == 0:
        raise ValueError("no window can be drawn around an empty mask; leave this view out")
    corners = pixels[torch.randint(len(pixels), (count,), generator=generator)] - size // 2
    return torch.minimum(corners.clamp(min=0), torch.tensor([height - size, width - size]))


def enlarge_to_fit(image: Tensor, size: int) -> Tensor:
    """Return an image [C, H, W], enlarged bilinearly if a window of `size` pixels does not fit into it.

    The shorter side is then `size`, and the proportions are kept up to rounding. If the window fits, `image` itself is
    returned.
    """
    height, width = image.shape[-2:]
    factor = size / min(height, width)
    if factor <= 1:
        return image
    shape = (max(size, round(height * factor)), max(size, round(width * factor)))
    return F.interpolate(image[None], size=shape, mode="bilinear", align_corners=False)[0]


def two_scales(image: Tensor, windows: list[tuple[int, int]], size: int, *, antialias: bool = True) -> Tensor:
    """Return an image at two scales: the whole view resized to a square, and patches at full resolution (section 4.2).

    The proportions of the whole view are not kept.

    Args:
        image: [C, H, W].
        windows: (top, left) of each patch.
        size: Side of the square and of the patches in pixels.
        antialias: Whether the bilinear reduction averages over all pixels, or skips those between its samples.

    Returns:
        [1 + len(windows), C, size, size], the whole view first; differentiable in `image`.
    """
    whole = F.interpolate(image[None], size=(size, size), mode="bilinear", align_corners=False, antialias=antialias)
    patches = [image[None, :, top : top + size, left : left + size] for top, left in windows]
    return torch.cat([whole, *patches])


def two_scale_masks(mask: Tensor, windows: list[tuple[int, int]], size: int) -> Tensor:
    """Return a mask at the two scales of `two_scales`, [1 + len(windows), 1, size, size] float, 1 = repaint.

    A pixel of the reduced view is repainted if any part of it is masked, because masked content must not reach the
    UNet.

    Args:
        mask: bool [H, W], True = repaint.
        windows: (top, left) of each patch.
        size: Side of the results in pixels.
    """
    return (two_scales(mask.to(torch.float32)[None], windows, size) > 1e-4).to(torch.float32)
