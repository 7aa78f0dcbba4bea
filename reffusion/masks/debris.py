"""Debris: Gaussians that the object hides, that become visible when it is removed, and that no photograph supports."""

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

COLOR_MARGIN = 10.0  # levels of 255: a color differs if it is further outside the range of colors around the pixel
ROUGH = 1.05  # ratio of farthest to nearest depth around a point above which the surface is rough
MISMATCH_SHARE = 0.5  # a Gaussian is debris if its color differs in a larger share of the views that see it


@torch.no_grad()
def find_debris(
    gaussians: Gaussians,
    labels: torch.Tensor,
    views: Sequence[DepthView],
    masks: Mapping[str, np.ndarray],
    photos: Mapping[str, np.ndarray],
) -> torch.Tensor:
    """Find the Gaussians that removing the object uncovers and that no photograph supports.

    Such Gaussians lie inside or behind the object, where no photograph supervised the fit. A Gaussian is debris if it
    meets two conditions. First, its blending weight in masked pixels, rendered without the object, exceeds 0.5 px in
    all views together, and also exceeds its blending weight in unmasked pixels, rendered with the object. Second, the
    number of views that show a surface at the Gaussian does not exceed the number of views that see past the Gaussian,
    or most of the views that show a surface there show a rough surface of another color. A Gaussian that no view can
    check meets the second condition, too.

    Args:
        gaussians: the N Gaussians of the whole scene, with the object.
        labels: bool [N], True for the Gaussians of the object.
        views: depth of the training views, rendered with the object.
        masks: view name -> bool [H, W], True at pixels where the photograph shows the object: C, and nothing in a clean
            view (photographed without the object).
        photos: view name -> uint8 [H, W, 3], the photographs in the exposure of the Gaussians.

    Returns:
        bool [N], True for debris; the Gaussians of the object are False.
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
    """Return int64 [N], for each Gaussian the number of views that show a rough surface of another color there.

    Smooth surfaces do not count: a Gaussian on a smooth surface is confirmed by its position, and its color may be
    view-dependent.

    Args:
        gaussians: N Gaussians.
        views: depth of the training views, rendered with the object.
        photos: view name -> uint8 [H, W, 3], the photographs in the exposure of the Gaussians.
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
