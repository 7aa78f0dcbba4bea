"""Debris: Gaussians that come to light when the object is removed, and that no photograph supports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import torch

from reffusion import geometry, morphology
from reffusion.background.visibility import ROUGHNESS, DepthView, count_views, is_seen
from reffusion.splat import rasterizer
from reffusion.splat.pure_torch import colors
from reffusion.types import Gaussians

COLOR_MARGIN = 10.0  # of 255: a Gaussian beyond the colours around its pixel by more than this has another colour
ROUGH = 1.05  # farthest over nearest depth around a point from which a surface is rough
MISMATCH_SHARE = 0.5  # of the views that see a Gaussian, those in which its colour must differ for it to be debris


@torch.no_grad()
def find_debris(
    gaussians: Gaussians,
    labels: torch.Tensor,
    views: Sequence[DepthView],
    masks: Mapping[str, np.ndarray],
    photos: Mapping[str, np.ndarray],
) -> torch.Tensor:
    """bool [N]: Gaussians that removing the object uncovers and that no photograph supports.

    They lie inside the object or in its shadow, where the fit was not supervised. Without the object they contribute
    more to masked pixels than they ever did to unmasked ones, and where other views can check, there is free space or a
    surface of another colour.

    Args:
        gaussians: N of them, with the object. labels: [N] bool, the object's.
        masks: view name -> bool [H, W], C. photos: view name -> uint8 [H, W, 3], in the exposure of the Gaussians.
    """
    remaining = gaussians.map(lambda p: p[~labels])
    uncovered, supervised = torch.zeros(len(remaining)), torch.zeros(len(remaining))
    for view in views:
        inside = torch.from_numpy(masks[view.camera.name])[..., None].to(gaussians.means)
        uncovered += rasterizer.accumulate(remaining, view.camera, inside)[:, 0].cpu()
        unmasked = torch.from_numpy(~view.masked)[..., None].to(gaussians.means)
        supervised += rasterizer.accumulate(gaussians, view.camera, unmasked)[:, 0].cpu()[~labels.cpu()]
    suspects = torch.nonzero((uncovered > 0.5) & (uncovered > supervised))[:, 0]
    suspected = remaining.map(lambda p: p[suspects.to(p.device)])
    visibility = count_views(suspected.means.double().cpu().numpy(), views)
    mismatches = count_color_mismatches(suspected, views, photos)
    unsupported = (visibility.seen <= visibility.free) | (mismatches > MISMATCH_SHARE * visibility.seen)
    found, rest = torch.zeros_like(labels), torch.nonzero(~labels)[:, 0]
    found[rest[suspects[torch.from_numpy(unsupported)].to(rest.device)]] = True
    return found


def count_color_mismatches(
    gaussians: Gaussians, views: Sequence[DepthView], photos: Mapping[str, np.ndarray]
) -> np.ndarray:
    """[N]: the number of views that show a surface at a Gaussian, but in another colour than its own.

    Only rough surfaces count. On a smooth one the position is evidence enough, and its colour may be view-dependent.
    """
    points, found = gaussians.means.double().cpu().numpy(), np.zeros(len(gaussians), np.int64)
    for view in views:
        own = colors(gaussians, view.camera, gaussians.sh_degree).cpu().numpy() * 255
        photo = photos[view.camera.name]
        window = morphology.square(morphology.to_pixels(ROUGHNESS, view.camera.width))
        uv, _ = geometry.project(points, view.camera)
        darkest, lightest = (geometry.sample_nearest(of(photo, window), uv)[0] for of in (cv2.erode, cv2.dilate))
        differs = ((own < darkest - COLOR_MARGIN) | (own > lightest.astype(float) + COLOR_MARGIN)).any(-1)
        nearest, farthest = (geometry.sample_nearest(of, uv)[0] for of in (view.nearest, view.farthest))
        found += differs & is_seen(view, points) & (farthest > nearest * ROUGH)
    return found
