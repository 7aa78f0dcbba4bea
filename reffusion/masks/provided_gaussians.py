"""The check that Gaussians which the scene provides lie in the same coordinate frame as its cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import torch

from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

WIDTH_PX = 160  # width of the images at which renderings and photographs are compared
LOW_PASS = 0.06  # of the width: coarser structure is removed, because e.g. sky above ground agrees in any two pictures
MIN_CORRELATION = 0.3  # least correlation of the finer structure; in the right frame it is above 0.8
MIN_COVERAGE = 0.2  # least share of a view's pixels that must show Gaussians


@torch.no_grad()
def explain_misplacement(
    gaussians: Gaussians, cameras: Sequence[Camera], photos: Mapping[str, np.ndarray]
) -> str | None:
    """Compare renderings of the Gaussians with photographs, and explain why the Gaussians seem to be misplaced.

    Args:
        cameras: some of the training views.
        photos: view name -> uint8 [H, W, 3].

    Returns:
        A sentence that states the problem; None if the median camera sees about what its photograph shows.
    """
    coverage, correlation = [], []
    for camera in cameras:
        small = camera.resized(WIDTH_PX, max(1, round(WIDTH_PX * camera.height / camera.width)))
        rendering = rasterizer.render(gaussians, small)
        photo = cv2.resize(photos[camera.name], (small.width, small.height), interpolation=cv2.INTER_AREA)
        coverage.append(float((rendering.alpha > 0.5).float().mean()))
        correlation.append(_cosine(_detail(rendering.color.cpu().numpy()), _detail(photo / np.float32(255))))
    if np.median(coverage) < MIN_COVERAGE:
        share = np.median(coverage)
        return f"the cameras see hardly anything of them ({share:.0%} of a view): they are in another frame"
    if np.median(correlation) < MIN_CORRELATION:
        return (
            f"their renders and the photographs are unlike (correlation {np.median(correlation):.2f}): they are in "
            "another frame than the cameras; give the cameras that they were fitted with"
        )
    return None


def _detail(image: np.ndarray) -> np.ndarray:
    """Return float32 [H, W], the brightness of an image [H, W, 3] without coarse structure."""
    gray = image.astype(np.float32).mean(-1)
    return gray - cv2.GaussianBlur(gray, (0, 0), LOW_PASS * gray.shape[1])


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    """Return the cosine of two images in [-1, 1], whose means are not subtracted; 1 if one of them is zero."""
    scale = float(np.sqrt((a**2).sum() * (b**2).sum()))
    return float((a * b).sum()) / scale if scale > 0 else 1.0
