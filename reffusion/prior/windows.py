"""Windows around masked pixels, and views at two scales: the inputs of SDS and personalization."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def window_around(mask: Tensor, size: int, generator: torch.Generator) -> tuple[int, int]:
    """(top, left) of a random size x size window inside the view that contains a masked pixel.

    PAPER leaves open: how a patch is sampled from the bounding box of the mask. A box may be mostly unmasked (a ring,
    two objects), so a masked pixel is sampled first, then its position in the window. The window is moved inside the
    view.

    Args:
        mask: [H, W] bool with at least one True pixel.
        size: side of the window in pixels, at most min(H, W).
    """
    return tuple(windows_around(mask, size, 1, generator)[0].tolist())


def windows_around(mask: Tensor, size: int, count: int, generator: torch.Generator) -> Tensor:
    """[count, 2] long: (top, left) of `count` independent windows as of `window_around`."""
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


def enlarge_to_fit(image: Tensor, size: int) -> Tensor:
    """[C, H, W] -> the same image, enlarged bilinearly if needed so that a window of `size` px fits into it."""
    height, width = image.shape[-2:]
    factor = size / min(height, width)
    if factor <= 1:
        return image
    shape = (max(size, round(height * factor)), max(size, round(width * factor)))
    return F.interpolate(image[None], size=shape, mode="bilinear", align_corners=False)[0]


def two_scales(image: Tensor, windows: list[tuple[int, int]], size: int) -> Tensor:
    """The whole view resized to size x size, and patches in full resolution (section 4.2).

    PAPER leaves open: whether the bilinear reduction is antialiased. It is, so that each rendered pixel receives a part
    of the global gradient; plain bilinear sampling of a large view would skip most pixels.

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

    A reduced pixel is repainted if any part of it is masked, because masked content must not reach the UNet.
    """
    return (two_scales(mask.to(torch.float32)[None], windows, size) > 1e-4).to(torch.float32)
