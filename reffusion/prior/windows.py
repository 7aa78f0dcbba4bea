"""Windows around masked pixels, and views at two scales: the inputs of SDS, of personalization and of the sampler."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def window_around(mask: Tensor, size: int, generator: torch.Generator) -> tuple[int, int]:
    """Draw a size x size window that shows masked and other pixels, and return its upper left corner (top, left).

    PAPER leaves open: how a patch is sampled from the bounding box of the mask. The center of the window is a masked
    pixel, because the box may be mostly unmasked (a ring, two objects). A window that extends beyond the view is moved
    inside. A window that is masked entirely is not drawn, because a prior is not adapted to pictures without any
    known pixel.

    Args:
        mask: bool [H, W] with at least one True and one False pixel.
        size: Side of the window in pixels, at least 2 and at most min(H, W).
        generator: The source of randomness, on the CPU.

    Raises:
        ValueError: The window does not fit into the view, or the mask is empty or covers the whole view.
    """
    corners = _corners(mask, size)
    for index in torch.randperm(len(corners), generator=generator).tolist():
        top, left = corners[index].tolist()
        if not mask[top : top + size, left : left + size].all():
            return top, left
    raise ValueError("no window shows a known pixel, since the mask covers the whole view; leave this view out")


def windows_around(mask: Tensor, size: int, count: int, generator: torch.Generator) -> Tensor:
    """Draw `count` independent windows around masked pixels, and return their corners (top, left), long [count, 2].

    In contrast to `window_around`, a window may be masked entirely.

    Raises:
        ValueError: A window does not fit into the view, or the mask is empty.
    """
    corners = _corners(mask, size)
    return corners[torch.randint(len(corners), (count,), generator=generator)]


def _corners(mask: Tensor, size: int) -> Tensor:
    """Return the corners (top, left) of windows around masked pixels, long [P, 2]; raises ValueError if none fits."""
    height, width = mask.shape
    if size > min(height, width):
        raise ValueError(f"a window of {size} px does not fit into a view of {width} x {height} px; enlarge it first")
    pixels = torch.nonzero(mask)
    if len(pixels) == 0:
        raise ValueError("no window can be drawn around an empty mask; leave this view out")
    return torch.minimum((pixels - size // 2).clamp(min=0), torch.tensor([height - size, width - size]))


def resize(images: Tensor, height: int, width: int) -> Tensor:
    """Resize images [B, C, H, W] to [B, C, height, width]: bilinear, and antialiased when shrinking.

    Every picture that a prior sees is resized by this function, in its adaptation, in distillation and in the sampler.
    """
    return F.interpolate(images, size=(height, width), mode="bilinear", align_corners=False, antialias=True)


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
    return resize(image[None], *shape)[0]


def two_scales(image: Tensor, windows: list[tuple[int, int]], size: int) -> Tensor:
    """Return an image at two scales: the whole view resized to a square, and patches at full resolution (section 4.2).

    The proportions of the whole view are not kept.

    Args:
        image: [C, H, W].
        windows: (top, left) of each patch.
        size: Side of the square and of the patches in pixels.

    Returns:
        [1 + len(windows), C, size, size], the whole view first; differentiable in `image`.
    """
    whole = resize(image[None], size, size)
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
