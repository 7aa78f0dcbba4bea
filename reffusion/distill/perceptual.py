"""The perceptual distance between patches: LPIPS if its weights are installed, else the multi-scale D-SSIM."""

from __future__ import annotations

from collections.abc import Callable

import torch.nn.functional as F
from torch import Tensor

from reffusion.gaussians.ssim import dssim
from reffusion.metrics import lpips

Distance = Callable[[Tensor, Tensor], Tensor]  # (render, target), [H, W, 3] in [0, 1] each -> scalar

SCALES = 3  # full, half and quarter size
MIN_SIDE = 11  # px, the side of SSIM's window


def load(device: str = "cpu") -> tuple[str, Distance]:
    """Return the name of a perceptual distance, and the distance as a function of two patches (see `Distance`).

    The distance is LPIPS (VGG) if its weights are installed. Else the distance is the multi-scale D-SSIM, and the name
    says why LPIPS is missing.

    Raises:
        ValueError: The weights of LPIPS are installed but damaged.
    """
    model, missing = lpips.load("vgg")
    if model is None:
        return f"multi-scale D-SSIM ({missing})", multi_scale_dssim
    model = model.to(device)

    def distance(render: Tensor, target: Tensor) -> Tensor:
        first, second = (image.permute(2, 0, 1)[None] * 2 - 1 for image in (render, target))
        return model(first, second).squeeze()

    return "LPIPS (vgg)", distance


def multi_scale_dssim(render: Tensor, target: Tensor) -> Tensor:
    """Return the mean of 1 - SSIM at full, half and quarter size, differentiable in `render`.

    This distance replaces LPIPS. Both tolerate a slight blur of coarse structure, but this distance does not recognize
    textures. Sizes at which a side is shorter than SSIM's window of 11 px are left out.

    Args:
        render, target: [H, W, 3] in [0, 1].

    Raises:
        ValueError: A side is shorter than 11 px at full size.
    """
    if min(target.shape[:2]) < MIN_SIDE:
        raise ValueError(f"D-SSIM needs {MIN_SIDE} px a side; the patch has {target.shape[1]}x{target.shape[0]} px")
    values = []
    for _ in range(SCALES):
        values.append(dssim(render, target))
        render, target = (_downsample(image) for image in (render, target))
        if min(target.shape[:2]) < MIN_SIDE:
            break
    return sum(values[1:], values[0]) / len(values)


def _downsample(image: Tensor) -> Tensor:
    """Return an image [H, W, C] at half its size, [H // 2, W // 2, C]."""
    return F.avg_pool2d(image.permute(2, 0, 1)[None], 2)[0].permute(1, 2, 0)
