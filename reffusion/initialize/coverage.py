"""What is still to be drawn: pixels of C that nothing covers, the next view to complete, and a reference's pixels that
lie over what remains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from reffusion import morphology
from reffusion.background.mirrors import render_mirrors
from reffusion.background.model import Background
from reffusion.background.visibility import OPAQUE, DepthView
from reffusion.masks import voting
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, Reference, Rendering

EDGE = 0.03  # relative depth of a step between two things; closer surfaces are the same
NARROW = 0.02  # of the image's width: a gap up to this wide shows no texture
MAX_ANGLE = 45.0  # degrees between the axis of a camera without a photograph and the nearest one with a photograph
MIN_SHARE = 0.001  # of a view's C: fewer uncovered pixels are left to its neighbours
ISLAND, GAP = 0.01, 0.02  # of the image's width: smaller islands of uncovered pixels are dropped, smaller holes filled


def expected_mirror_depth(background: Background) -> dict[str, np.ndarray]:
    """View name -> [H, W], depth of the plausible mirror images in C, inf elsewhere; empty where there is no mirror."""
    if not background.mirrors:
        return {}
    render = lambda camera: (
        render_mirrors(background.mirrors, camera, background.masks[camera.name], background.views).plausible_depth
    )
    return {camera.name: render(camera) for camera in background.cameras}


@torch.no_grad()
def find_uncovered(
    gaussians: Gaussians,
    is_new: Tensor,
    background: Background,
    cameras: Sequence[Camera],
    mirror_depth: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """View name -> bool [H, W], pixels of C that nothing covers, or that show something else than the plausible mirror
    image there.

    Only these are completed: without a true picture an invented surface is worse than what is there, unobserved or not.
    """
    found = {}
    for camera in cameras:
        mask = background.masks[camera.name]
        rendering = rasterizer.render(
            gaussians, camera, features=is_new[:, None].to(gaussians.means.dtype), sh_degree=0
        )
        uncovered = rendering.alpha.cpu().numpy() <= OPAQUE
        if camera.name in mirror_depth:
            uncovered |= _contradicts(mirror_depth[camera.name], rendering, background.unobserved[camera.name])
        island, gap = ISLAND * camera.width, GAP * camera.width
        found[camera.name] = morphology.remove_small_parts(mask & uncovered, island, gap) & mask
    return found


def _contradicts(image_depth: np.ndarray, rendering: Rendering, unobserved: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels at which something unobserved, that no reference drew, occludes the mirror image, or nothing
    is as near as the image."""
    depth, is_new = (each.cpu().numpy() for each in (rendering.depth, rendering.features[..., 0] > 0.5))
    in_front = (depth < (1 - EDGE) * image_depth) & ~is_new & unobserved
    return np.isfinite(image_depth) & (in_front | (image_depth < (1 - EDGE) * depth))


def find_floaters(
    gaussians: Gaussians, is_new: Tensor, background: Background, uncovered: Mapping[str, np.ndarray], tau: float
) -> Tensor:
    """bool [N]: old Gaussians that are visible mostly where nothing else covers C."""
    return voting.find_floaters(gaussians, background.cameras, uncovered, tau) & ~is_new


@torch.no_grad()
def completed_views(
    references: Sequence[Reference], gaussians: Gaussians, background: Background
) -> list[tuple[DepthView, np.ndarray]]:
    """The references as depth views of the completed scene, unmasked where they are completed, and their pictures."""
    views, found = {view.camera.name: view for view in background.views}, []
    for each in references:
        rendering = rasterizer.render(gaussians, each.camera, sh_degree=0)
        depth = torch.where(rendering.alpha > OPAQUE, rendering.depth, 0.0).cpu().numpy()
        view = views[each.camera.name]
        found.append((replace(view, depth=depth, masked=view.masked & ~each.mask), each.image))
    return found


def cameras_near_photographs(background: Background) -> list[Camera]:
    """The cameras whose views may be completed: those with a photograph, and those that look about the same way.

    An invention seen from elsewhere knows nothing of what is there, and may hide what photographs show.
    """
    axis = lambda camera: camera.world_to_camera[2, :3]
    photographed = [camera for camera in background.cameras if camera.name not in background.without_photo]
    axes = np.stack([axis(camera) for camera in photographed])
    is_near = lambda camera: float((axes @ axis(camera)).max()) > np.cos(np.radians(MAX_ANGLE))
    return [camera for camera in background.cameras if camera.name not in background.without_photo or is_near(camera)]


def least_covered_view(
    cameras: Sequence[Camera], background: Background, uncovered: Mapping[str, np.ndarray]
) -> Camera | None:
    """The camera of the view with most uncovered pixels; None where every view has too few to count."""
    candidates = [
        camera
        for camera in cameras
        if uncovered[camera.name].sum() > MIN_SHARE * max(background.masks[camera.name].sum(), 1)
    ]
    return max(candidates, key=lambda camera: int(uncovered[camera.name].sum()), default=None)


def is_narrow(mask: np.ndarray) -> bool:
    """Whether the mask, bool [H, W], is nowhere wider than a gap without texture."""
    distance = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return 2 * float(distance.max()) <= NARROW * mask.shape[1]


@torch.no_grad()
def uncovered_share(gaussians: Gaussians, camera: Camera, mask: np.ndarray, min_alpha: float = 0.9) -> float:
    """Share in [0, 1] of C, bool [H, W], whose alpha is below `min_alpha`."""
    alpha = rasterizer.render(gaussians, camera, sh_degree=0).alpha.cpu().numpy()
    return float((alpha[mask] < min_alpha).mean()) if mask.any() else 0.0


@torch.no_grad()
def pixels_in_front(gaussians: Gaussians, depth: np.ndarray, reference: Reference, mask: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels outside C whose surface is nearer than every Gaussian. Most are the inner side of a surface
    that an earlier reference added.

    Args:
        depth: [H, W] of the reference's surface. mask: bool [H, W], C.
    """
    rendering = rasterizer.render(gaussians, reference.camera, sh_degree=0)
    visible = torch.where(rendering.alpha > 0.5, rendering.depth, torch.inf).double().cpu().numpy()
    return reference.mask & ~mask & (depth < (1 - EDGE) * visible)


def beside_depth_edges(depth: np.ndarray, remaining_depth: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels at the farther side of a depth edge whose surface belongs to the remaining scene.

    The colour of the nearer surface bleeds into these pixels of a completed view; photographs show them clean.

    Args:
        depth, remaining_depth: [H, W] of the completed view, and of the scene that remains.
    """
    nearest = cv2.erode(depth, np.ones((3, 3)))
    return (depth > (1 + EDGE) * nearest) & (np.abs(depth - remaining_depth) < EDGE * remaining_depth)
