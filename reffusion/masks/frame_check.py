"""Gaussians from elsewhere: are they in the frame of the cameras?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import torch

from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

WIDTH = 160  # px, at which they are compared
COARSE = 0.06  # of the width: what changes more slowly, like sky over ground, is alike in any two pictures
ALIKE = 0.3  # correlation of the rest under which it is another place; it is above 0.8 where it is the same
SHOWN = 0.2  # of a view's pixels that must show something


@torch.no_grad()
def misplaced(gaussians: Gaussians, cameras: Sequence[Camera], photos: Mapping[str, np.ndarray]) -> str | None:
    """What is wrong, in words; None where most of the cameras see what their photographs show.

    Args:
        photos: view name -> uint8 [H, W, 3].
    """
    shown, alike = [], []
    for camera in cameras:
        small = camera.resized(WIDTH, max(1, round(WIDTH * camera.height / camera.width)))
        drawn = rasterizer.render(gaussians, small)
        photo = cv2.resize(photos[camera.name], (small.width, small.height), interpolation=cv2.INTER_AREA)
        shown.append(float((drawn.alpha > 0.5).float().mean()))
        alike.append(_correlation(_detail(drawn.color.cpu().numpy()), _detail(photo / np.float32(255))))
    if np.median(shown) < SHOWN:
        return f"the cameras see hardly anything of them ({np.median(shown):.0%} of a view): they are in another frame"
    if np.median(alike) < ALIKE:
        return (
            f"their renders and the photographs are unlike (correlation {np.median(alike):.2f}): they are in another "
            "frame than the cameras; give the cameras that they were fitted with"
        )
    return None


def _detail(image: np.ndarray) -> np.ndarray:
    """[h, w], brightness without what changes slowly."""
    grey = image.astype(np.float32).mean(-1)
    return grey - cv2.GaussianBlur(grey, (0, 0), COARSE * grey.shape[1])


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    scale = float(np.sqrt((a**2).sum() * (b**2).sum()))
    return float((a * b).sum()) / scale if scale > 0 else 1.0
