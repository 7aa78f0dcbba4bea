"""Coverage of the hole during `initialize`: which pixels of C still have to be filled, and from which view.

C is the consistent mask of a view: the pixels of the removed object. The draft is the scene that is being filled; it
consists of the remaining Gaussians (the scene without the object) and of the new ones that references added.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from reffusion import geometry, morphology
from reffusion.background.mirrors import render_mirrors
from reffusion.background.model import Background
from reffusion.background.visibility import OPAQUE, DepthView, opaque_depth
from reffusion.gaussians.surfels import is_beside_nearer
from reffusion.kernels.compiled import map_in_threads, views_at_once
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, Reference, Rendering

NARROW = 0.02  # largest width of a gap that is too narrow to show texture, as a fraction of the image's width
MAX_ANGLE = 45.0  # degrees: largest angle from the axis of a camera without a photograph to the nearest one with one
MIN_SHARE = 0.001  # a view is completed only if a larger share of its C is uncovered; neighbors complete the rest


def expected_mirror_depth(background: Background) -> dict[str, np.ndarray]:
    """Return for each view the depth at which its hole should show mirror images of symmetric things.

    A thing beside the object may be mirror-symmetric (`reffusion.background.mirrors`). Then the mirror image of its
    visible part shows the part that the object hides.

    Returns:
        View name -> float64 [H, W], the camera z of the plausible mirror images inside C, and inf elsewhere. A mirror
        image is plausible where photographs show the part that is mirrored, and the views do not see past the image
        (`Visibility.is_empty`). The dictionary is empty if the background has no mirrors.
    """
    if not background.mirrors:
        return {}
    render = lambda camera: (
        render_mirrors(background.mirrors, camera, background.masks[camera.name], background.views).plausible_depth
    )
    names, at_once = (
        [camera.name for camera in background.cameras],
        views_at_once(background.mirrors[0].thing.means.device),
    )
    return dict(zip(names, map_in_threads(render, background.cameras, at_once), strict=True))


def find_uncovered(
    gaussians: Gaussians,
    is_new: Tensor,
    background: Background,
    cameras: Sequence[Camera],
    mirror_depth: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """Return for each view the pixels of C that still have to be completed.

    A pixel is uncovered if its alpha is at most `OPAQUE`, or if its surface contradicts a plausible mirror image
    (`_contradicts`). Covered pixels are left as they are, even if no photograph shows their surface: without a true
    picture, an invented surface is worse than the present one.

    Args:
        gaussians: the N Gaussians of the draft.
        is_new: bool [N], True for the Gaussians that references added.
        background: the photographs and surfaces around the object.
        cameras: the views to examine.
        mirror_depth: the result of `expected_mirror_depth`.

    Returns:
        View name -> bool [H, W], True for uncovered pixels, without small islands and with small holes filled.
    """
    features = is_new[:, None].to(gaussians.means.dtype)

    @torch.no_grad()
    def find(camera: Camera) -> np.ndarray:
        mask = background.masks[camera.name]
        rendering = rasterizer.render(gaussians, camera, features=features, sh_degree=0)
        uncovered = rendering.alpha.cpu().numpy() <= OPAQUE
        if camera.name in mirror_depth:
            uncovered |= _contradicts(mirror_depth[camera.name], rendering, background.unobserved[camera.name])
        island, gap = morphology.ISLAND * camera.width, morphology.GAP * camera.width
        return morphology.remove_small_parts(mask & uncovered, island, gap) & mask

    return dict(
        zip(
            [camera.name for camera in cameras],
            map_in_threads(find, cameras, views_at_once(gaussians.means.device)),
            strict=True,
        )
    )


def _contradicts(image_depth: np.ndarray, rendering: Rendering, unobserved: np.ndarray) -> np.ndarray:
    """Return bool [H, W], where a rendering contradicts a plausible mirror image, whose camera z is `image_depth`."""
    depth, is_new = (each.cpu().numpy() for each in (rendering.depth, rendering.features[..., 0] > 0.5))
    # The rendering contradicts the image (`image_depth` is its camera z, inf where there is none) where the rendered
    # surface lies behind the image. It also does so where the rendered surface lies in front of the image, no reference
    # added this surface, and the pixel is unobserved: no photograph shows its background.
    in_front = (depth < (1 - geometry.OTHER_SURFACE) * image_depth) & ~is_new & unobserved
    return np.isfinite(image_depth) & (in_front | (image_depth < (1 - geometry.OTHER_SURFACE) * depth))


@torch.no_grad()
def completed_views(
    references: Sequence[Reference], gaussians: Gaussians, background: Background
) -> list[tuple[DepthView, np.ndarray]]:
    """Convert references to sources of texture for further views.

    Each reference must be a view of `background.views`.

    Returns:
        For each reference its depth view and its picture, uint8 [H, W, 3]. The depth is that of `gaussians`, rendered
        in the reference's view, and 0 where alpha is at most `OPAQUE`. The object's mask of the depth view does not
        contain the pixels that the reference completed. Its `near_ratio` and `far_ratio` are those of the view with the
        object.
    """
    views, found = {view.camera.name: view for view in background.views}, []
    for each in references:
        rendering = rasterizer.render(gaussians, each.camera, sh_degree=0)
        view = views[each.camera.name]
        found.append((replace(view, depth=opaque_depth(rendering), masked=view.masked & ~each.mask), each.image))
    return found


def cameras_near_photographs(background: Background) -> list[Camera]:
    """Return the cameras whose views may be completed.

    These are all cameras with a photograph, and each camera without one whose optical axis is within `MAX_ANGLE` of the
    axis of a camera with a photograph. A view from elsewhere would be invented without knowledge of its surroundings,
    and the invented surface might hide surfaces that photographs show.
    """
    axis = lambda camera: camera.world_to_camera[2, :3]
    photographed = [camera for camera in background.cameras if camera.name not in background.camera_only]
    axes = np.stack([axis(camera) for camera in photographed])
    is_near = lambda camera: float((axes @ axis(camera)).max()) > np.cos(np.radians(MAX_ANGLE))
    return [camera for camera in background.cameras if camera.name not in background.camera_only or is_near(camera)]


def least_covered_view(
    cameras: Sequence[Camera], background: Background, uncovered: Mapping[str, np.ndarray]
) -> Camera | None:
    """Return the camera of the view with the most uncovered pixels, counted absolutely.

    Args:
        cameras: the candidates.
        background: holds C of each view.
        uncovered: view name -> bool [H, W], the result of `find_uncovered`.

    Returns:
        The camera; None if in no view more than `MIN_SHARE` of C is uncovered. A view with a smaller share is not
        returned, however many its uncovered pixels are.
    """
    candidates = [
        camera
        for camera in cameras
        if uncovered[camera.name].sum() > MIN_SHARE * max(background.masks[camera.name].sum(), 1)
    ]
    return max(candidates, key=lambda camera: int(uncovered[camera.name].sum()), default=None)


def is_narrow(mask: np.ndarray) -> bool:
    """Return whether a mask, bool [H, W], is too narrow to show texture: nowhere wider than `NARROW`; True if empty."""
    distance = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return 2 * float(distance.max()) <= NARROW * mask.shape[1]


@torch.no_grad()
def pixels_in_front(gaussians: Gaussians, depth: np.ndarray, reference: Reference, mask: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the reference's pixels outside C whose surface lies clearly in front of the rendered draft.

    Where the draft has an alpha up to 0.5, every surface is in front of it. At most of the other pixels the draft shows
    the inner side of a surface that an earlier reference added.

    Args:
        gaussians: the Gaussians of the draft.
        depth: [H, W], camera z of the surface that the reference shows.
        reference: the completed view; only pixels of its mask are returned.
        mask: bool [H, W], C of the view.
    """
    rendering = rasterizer.render(gaussians, reference.camera, sh_degree=0)
    visible = torch.where(rendering.alpha > 0.5, rendering.depth, torch.inf).double().cpu().numpy()
    return reference.mask & ~mask & (depth < (1 - geometry.OTHER_SURFACE) * visible)


def beside_depth_edges(depth: np.ndarray, remaining_depth: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the pixels on the farther side of a depth edge whose surface belongs to the remaining scene.

    In a completed view the color of the nearer surface bleeds into these pixels. Photographs show them without it.

    Args:
        depth: [H, W], camera z of the surfaces in the completed view.
        remaining_depth: [H, W], camera z of the remaining Gaussians (the scene without the object) in the same view.
    """
    is_remaining = np.abs(depth - remaining_depth) < geometry.OTHER_SURFACE * remaining_depth
    return is_beside_nearer(depth, 1 + geometry.OTHER_SURFACE) & is_remaining
