"""The perceptual distance that supervises patches: LPIPS where its weights lie on the machine, else a stand-in."""

from __future__ import annotations

from collections.abc import Callable

import torch.nn.functional as F
from torch import Tensor

from reffusion.gaussians.ssim import dssim
from reffusion.metrics import lpips

Distance = Callable[[Tensor, Tensor], Tensor]  # (render, target), [H, W, 3] in [0, 1] each -> scalar

SCALES = 3
SMALLEST = 11  # px a side, SSIM's window


def load(device: str = "cpu") -> tuple[str, Distance]:
    """The name of the distance, and the distance: LPIPS (vgg), else the multi-scale D-SSIM.

    Raises:
        ValueError: LPIPS weights that are there but broken.
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
    """Mean of 1 - SSIM over the picture at full, half and quarter size, as far as a window fits.

    Not LPIPS: like it blind to a slight blur of what is coarse, unlike it without any knowledge of textures.

    Args:
        render, target: [H, W, 3] in [0, 1]; the gradient reaches `render`.
    Raises:
        ValueError: under 11 px a side.
    """
    if min(target.shape[:2]) < SMALLEST:
        raise ValueError(f"D-SSIM needs {SMALLEST} px a side; the patch has {target.shape[1]}x{target.shape[0]} px")
    values = []
    for _ in range(SCALES):
        values.append(dssim(render, target))
        render, target = (_halved(image) for image in (render, target))
        if min(target.shape[:2]) < SMALLEST:
            break
    return sum(values) / len(values)


def _halved(image: Tensor) -> Tensor:
    return F.avg_pool2d(image.permute(2, 0, 1)[None], 2)[0].permute(1, 2, 0)
