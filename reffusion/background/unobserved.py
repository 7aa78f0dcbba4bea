"""Which pixels behind the object are unobserved: no other photograph shows what would be visible there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from reffusion import morphology
from reffusion.background.mirrors import Mirror, render_mirrors
from reffusion.background.plane import IN_FRONT, Plane
from reffusion.background.visibility import (
    MASK_MARGIN,
    OPAQUE,
    SURFACE,
    DepthView,
    count_views,
    depth_range,
    smooth_surface,
    with_photographed_depth,
)
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

RING = 0.03  # of the image's width: how far around a plane's patch it is compared with the rendered depth
DEPTH_EDGE = 0.06  # of the depth: a wider range around a pixel is a depth edge, not a rough surface
CONFIRMING_VIEWS = 3  # views that must show a surface for it to exist although most around it is unobserved
MIN_AGREEMENT = 0.6  # share of the pixels beside a plane's patch that must lie on it, of those that are not occluded
MIN_SHARE = 0.3  # the same, of all pixels beside the patch


@dataclass(frozen=True)
class HoleGeometry:
    """What one view shows once the object is removed.

    Attributes:
        unobserved: bool [H, W], inside C: no photograph tells what is visible there.
        continued_depth: [H, W], on `unobserved` pixels the depth of the plane that continues there, or of a mirror
            image; inf where there is none, and elsewhere.
        depth, alpha: [H, W] float64, rendered; outside the mask the photographed depth.
        plane_depths: [H, W] each, the depth of every plane that continues in this view, at all pixels; inf where a ray
            does not meet it.
        confirmed: bool [H, W], inside C: a few views show the rendered surface; without small specks.
    """

    unobserved: np.ndarray
    continued_depth: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray
    plane_depths: tuple[np.ndarray, ...]
    confirmed: np.ndarray


@torch.no_grad()
def find_unobserved(
    remaining: Gaussians,
    camera: Camera,
    mask: np.ndarray,
    views: Sequence[DepthView],
    planes: Sequence[Plane],
    mirrors: Sequence[Mirror] = (),
) -> HoleGeometry:
    """Split the pixels of C into observed and unobserved ones.

    The remaining Gaussians are rendered, each pixel is unprojected, and the views count that see this point unmasked,
    at the same depth and from the same side. A pixel is observed if at least a quarter of the views that could see the
    point do (`Visibility.is_observed`), and if no plane or mirror image continues in front of it. The quarter excludes
    Gaussians that most views place below a surface; these are fitting artifacts.

    Args:
        remaining: the M Gaussians without the object.
        mask: bool [H, W], C of the view.
        planes, mirrors: of the surroundings, see `background.model`.
    """
    rendering = rasterizer.render(remaining, camera, sh_degree=0)
    depth, alpha = (t.double().cpu().numpy() for t in (rendering.depth, rendering.alpha))
    rows, columns = np.nonzero(mask & (alpha > OPAQUE))
    unobserved, confirmed = mask.copy(), np.zeros_like(mask)
    if len(rows):
        points, normals = (each[rows, columns] for each in smooth_surface(depth, camera))
        visibility = count_views(points, views, normals)
        unobserved[rows, columns] = ~visibility.is_observed
        confirmed[rows, columns] = visibility.is_observed & (visibility.seen >= CONFIRMING_VIEWS)
    depth = with_photographed_depth(depth, camera, views)
    occluding, nearest, plane_depths = np.zeros_like(mask), np.full(mask.shape, np.inf), []
    for plane in planes:
        at = plane.depth(camera)
        in_front = at < IN_FRONT * np.where(depth > 0, depth, np.inf)
        before = plane.pixels_on(plane.continued, at, camera, mask & in_front)
        # A plane also continues where nothing is known, but not behind something that stands in front of it.
        beneath = plane.pixels_on(
            plane.enclosed, at, camera, unobserved & ((at < depth / IN_FRONT) | (alpha <= OPAQUE))
        )
        if _continues_surroundings(before | beneath, plane, at, camera, depth, ~mask & (alpha > OPAQUE)):
            occluding |= before
            plane_depths.append(at)
            nearest = np.where(before | beneath, np.minimum(nearest, at), nearest)
    if mirrors:
        image = render_mirrors(mirrors, camera, mask, views)
        occluding |= image.plausible_depth < IN_FRONT * np.where((depth > 0) & (alpha > OPAQUE), depth, np.inf)
        plane_depths.append(image.depth)
        # A plane may cut through a round thing: the image wins where both are about as near.
        wins = (occluding | unobserved) & (image.plausible_depth < (1 + SURFACE) * nearest)
        nearest = np.where(wins, image.plausible_depth, nearest)
    unobserved = morphology.remove_slivers(unobserved | occluding, MASK_MARGIN) & mask
    below = _below_planes(planes, camera, depth, mask)
    confirmed = morphology.remove_slivers(confirmed & ~occluding & ~below, MASK_MARGIN) & mask
    continued_depth = np.where(unobserved, nearest, np.inf)
    return HoleGeometry(unobserved, continued_depth, depth, alpha, tuple(plane_depths), confirmed)


def _below_planes(planes: Sequence[Plane], camera: Camera, depth: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """bool [H, W]: those of `pixels` that show something below a plane, or reflected in it."""
    found = np.zeros_like(pixels)
    for plane in planes:
        at = plane.depth(camera)
        cells = plane.reflective | plane.enclosed | plane.seen
        found |= plane.pixels_on(cells, at, camera, pixels & (at < IN_FRONT * depth))
    return found


def _continues_surroundings(
    patch: np.ndarray, plane: Plane, plane_depth: np.ndarray, camera: Camera, depth: np.ndarray, known: np.ndarray
) -> bool:
    """Whether the plane agrees with the rendered depth around a patch of it, bool [H, W], or most views show it there.

    A plane that only cuts through what stands there does not. Pixels at which views see through the plane are ignored.
    """
    if not patch.any():
        return False
    radius = max(3, round(RING * patch.shape[1]))
    ring = cv2.dilate(patch.astype(np.uint8), morphology.square(radius)) > 0
    ring &= known & np.isfinite(plane_depth)
    ring &= ~plane.pixels_on(plane.free, plane_depth, camera, ring)
    if not ring.any():
        return False
    nearest, farthest = depth_range(depth)
    agrees = (plane_depth > nearest * (1 - SURFACE)) & (plane_depth < farthest * (1 + SURFACE))
    agrees &= np.abs(plane_depth - depth) < DEPTH_EDGE * depth
    # One view may be wrong about rough ground, or see through a reflection; the other views decide.
    agrees |= plane.pixels_on(plane.seen, plane_depth, camera, ring)
    disagrees = ~agrees & (depth > plane_depth)  # where something occludes the plane it may continue
    share, against = float(agrees[ring].mean()), float(disagrees[ring].mean())
    return share > MIN_SHARE and share > MIN_AGREEMENT * (share + against)
