"""Windows of a view around its masked pixels, and a view at two scales: what SDS and personalization are shown."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def window_around(mask: Tensor, size: int, generator: torch.Generator) -> tuple[int, int]:
    """(top, left) of a size x size window inside the view that shows a randomly drawn masked pixel.

    PAPER leaves open: how a patch is drawn from the mask's box. A box may be mostly unmasked (a ring, two objects),
    so a masked pixel is drawn first, then its place in the window; the window is pushed back inside the view.

    Args:
        mask: [H, W] bool with at least one True pixel.
        size: side of the window in pixels, at most min(H, W).
    """
    return tuple(windows_around(mask, size, 1, generator)[0].tolist())


def windows_around(mask: Tensor, size: int, count: int, generator: torch.Generator) -> Tensor:
    """[count, 2] long: (top, left) of each of `count` windows, drawn independently as by `window_around`."""
    height, width = mask.shape
    if size > min(height, width):
        raise ValueError(f"a window of {size} px does not fit into a view of {width} x {height} px; enlarge it first")
    pixels = torch.nonzero(mask)
    if len(pixels) == 0:
        raise ValueError("no window can be drawn around an empty mask; leave this view out")
    picks = torch.randint(len(pixels), (count,), generator=generator)
    shifts = torch.randint(size, (count, 2), generator=generator)
    corners = pixels[picks] - shifts
    return torch.minimum(corners.clamp(min=0), torch.tensor([height - size, width - size]))


def enlarged(image: Tensor, size: int) -> Tensor:
    """[C, H, W] -> the same image, bilinearly enlarged where needed so that a window of `size` px fits into it."""
    height, width = image.shape[-2:]
    factor = size / min(height, width)
    if factor <= 1:
        return image
    shape = (max(size, round(height * factor)), max(size, round(width * factor)))
    return F.interpolate(image[None], size=shape, mode="bilinear", align_corners=False)[0]


def two_scales(image: Tensor, windows: list[tuple[int, int]], size: int) -> Tensor:
    """The whole view resized to size x size, then its patches in full resolution (section 4.2).

    PAPER leaves open: whether the bilinear reduction is antialiased. It is: each rendered pixel then receives a
    share of the global gradient, where plain bilinear sampling of a large view would skip most of them.

    Args:
        image: [C, H, W].
        windows: (top, left) of each patch.
    Returns:
        [1 + len(windows), C, size, size], differentiable in `image`.
    """
    whole = F.interpolate(image[None], size=(size, size), mode="bilinear", align_corners=False, antialias=True)
    patches = [image[None, :, top : top + size, left : left + size] for top, left in windows]
    return torch.cat([whole, *patches])


def two_scale_masks(mask: Tensor, windows: list[tuple[int, int]], size: int) -> Tensor:
    """`two_scales` of a bool [H, W] mask -> [1 + len(windows), 1, size, size] float, 1 = repaint.

    A reduced pixel is repainted as soon as any part of it was masked: what is masked must not reach the UNet.
    """
    return (two_scales(mask.to(torch.float32)[None], windows, size) > 1e-4).to(torch.float32)
