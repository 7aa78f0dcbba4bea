"""The split of a view's consistent mask C (the pixels that show the object) into observed and unobserved pixels.

A pixel is *unobserved* if too few other photographs show the background there, the surface that is visible once the
object is removed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from reffusion import geometry, morphology
from reffusion.background.mirrors import Mirror, render_mirrors
from reffusion.background.plane import IN_FRONT, Plane
from reffusion.background.visibility import (
    MASK_MARGIN,
    OPAQUE,
    DepthView,
    count_views,
    depth_range,
    smooth_surface,
    with_photographed_depth,
)
from reffusion.types import Camera, Rendering

RING = 0.03  # of the image's width: distance from a patch of a plane up to which the plane is compared with the depth
# Relative depth by which a pixel on a plane may differ from the plane. At a depth edge the depth range around a pixel
# is wider. There a plane may lie within this range without agreeing.
DEPTH_EDGE = 0.06
CONFIRMING_VIEWS = 3  # number of views that must show a surface to confirm it
MIN_AGREEMENT = 0.6  # least share of pixels on the plane, of the pixels beside a patch where nothing occludes the plane
MIN_SHARE = 0.3  # least share of pixels on the plane, of all pixels beside a patch


@dataclass(frozen=True)
class HoleGeometry:
    """The surfaces that one view shows once the object is removed.

    Attributes:
        unobserved: bool [H, W], True at pixels of C whose background too few views show.
        continued_depth: [H, W], at unobserved pixels the camera z of the nearest plane that continues there, or of the
            plausible mirror image of a symmetric thing; inf where there is neither, and at all other pixels.
        depth: [H, W] float64 camera z, rendered from the remaining Gaussians (those without the object). Outside the
            mask it is the depth that the view shows with the object, if the view is among the training views.
        plane_depths: [H, W] each, for every plane that continues in this view its depth at all pixels, inf where a ray
            does not meet it. If there are mirrors, the last entry is the depth of their mirror images, inf elsewhere.
        confirmed: bool [H, W], True at the pixels of C where at least `CONFIRMING_VIEWS` views show the rendered
            surface, and no plane or mirror image lies in front of this surface. Small specks are removed.
    """

    unobserved: np.ndarray
    continued_depth: np.ndarray
    depth: np.ndarray
    plane_depths: tuple[np.ndarray, ...]
    confirmed: np.ndarray


@torch.no_grad()
def find_unobserved(
    rendering: Rendering,
    camera: Camera,
    mask: np.ndarray,
    views: Sequence[DepthView],
    planes: Sequence[Plane],
    mirrors: Sequence[Mirror] = (),
) -> HoleGeometry:
    """Split the pixels of C, the mask of the object in a view, into observed and unobserved pixels.

    Each pixel of C is unprojected to a point of the background. A view shows the point if it sees the point outside its
    mask, at the same depth and from the same side. The pixel is observed if at least a quarter of the views that could
    see the point show the point (`Visibility.is_observed`), and if no plane or mirror image continues in front of the
    point. The quarter excludes Gaussians that most views place below a surface, which are fitting artifacts. Pixels
    where the remaining Gaussians are not opaque are unobserved.

    Args:
        rendering: the remaining Gaussians, rendered in the view.
        camera: the view.
        mask: bool [H, W], C of the view.
        views: depth of the training views, rendered with the object.
        planes, mirrors: planes and symmetric things around the object, see `background.model`.
    """
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
        # A plane also continues into unobserved pixels, but not behind an opaque surface in front of the plane.
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
        # A plane may cut through a round thing. So the mirror image takes precedence if both are about equally near.
        wins = (occluding | unobserved) & (image.plausible_depth < (1 + geometry.SAME_SURFACE) * nearest)
        nearest = np.where(wins, image.plausible_depth, nearest)
    unobserved = morphology.remove_slivers(unobserved | occluding, MASK_MARGIN) & mask
    below = _below_planes(planes, camera, depth, mask)
    confirmed = morphology.remove_slivers(confirmed & ~occluding & ~below, MASK_MARGIN) & mask
    continued_depth = np.where(unobserved, nearest, np.inf)
    return HoleGeometry(unobserved, continued_depth, depth, tuple(plane_depths), confirmed)


def _below_planes(planes: Sequence[Plane], camera: Camera, depth: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return bool [H, W], which of `pixels` have a depth behind a plane: they show a reflection or an artifact."""
    found = np.zeros_like(pixels)
    for plane in planes:
        at = plane.depth(camera)
        cells = plane.reflective | plane.enclosed | plane.seen
        found |= plane.pixels_on(cells, at, camera, pixels & (at < IN_FRONT * depth))
    return found


def _continues_surroundings(
    patch: np.ndarray, plane: Plane, plane_depth: np.ndarray, camera: Camera, depth: np.ndarray, known: np.ndarray
) -> bool:
    """Return whether a plane agrees with the surfaces around `patch`, so that it may continue into the patch."""
    if not patch.any():
        return False
    radius = max(3, round(RING * patch.shape[1]))
    ring = morphology.dilate_square(patch, radius)
    ring &= known & np.isfinite(plane_depth)
    # pixels at which views see through the plane are ignored
    ring &= ~plane.pixels_on(plane.free, plane_depth, camera, ring)
    if not ring.any():
        return False
    # A plane that merely cuts through a solid thing does not agree with the depth beside the patch.
    nearest, farthest = depth_range(depth)
    agrees = plane_depth > nearest * (1 - geometry.SAME_SURFACE)
    agrees &= plane_depth < farthest * (1 + geometry.SAME_SURFACE)
    agrees &= np.abs(plane_depth - depth) < DEPTH_EDGE * depth
    # The depth of one view may be wrong on rough ground and in reflections. There the other views decide.
    agrees |= plane.pixels_on(plane.seen, plane_depth, camera, ring)
    disagrees = ~agrees & (depth > plane_depth)  # a surface in front of the plane merely occludes it
    share, against = float(agrees[ring].mean()), float(disagrees[ring].mean())
    return share > MIN_SHARE and share > MIN_AGREEMENT * (share + against)
