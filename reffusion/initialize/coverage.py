"""What is still to be drawn: of a reference over what stays; of other views what no reference shows, and which next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from reffusion.background.mirrors import imaged
from reffusion.background.visibility import OPAQUE, Witness
from reffusion.initialize.unprojection import Surroundings
from reffusion.masks import voting
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, Reference, Rendering

EDGE = 0.03  # relative depth: of a step between two things, and within which two surfaces are the same
NARROW = 0.02  # of the image's width: a gap up to so wide shows no texture
BESIDE = 45.0  # degrees between the axis of a camera without a photograph and that of the nearest with one
ENOUGH = 0.001  # share of a view's C under which what is open is left to its neighbours


def mirrored(around: Surroundings) -> dict[str, np.ndarray]:
    """View name -> [H, W], the depth of the mirror images that are supposed to be in C, infinite elsewhere; none where
    nothing is mirrored."""
    image = lambda camera: imaged(around.mirrors, camera, around.hidden[camera.name], around.views).supposed
    return {camera.name: image(camera) for camera in around.cameras} if around.mirrors else {}


@torch.no_grad()
def open_pixels(
    gaussians: Gaussians,
    new: Tensor,
    around: Surroundings,
    cameras: Sequence[Camera],
    mirrored: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """View name -> bool [H, W], pixels of C that nothing covers, or that show something else than a mirror image which
    is supposed to be there.

    Only these are made up: without a true picture a made-up surface is worse than what stands there, undecided or not.
    """
    found = {}
    for camera in cameras:
        hidden = around.hidden[camera.name]
        drawn = rasterizer.render(gaussians, camera, features=new[:, None].to(gaussians.means.dtype), sh_degree=0)
        bare = drawn.alpha.cpu().numpy() <= OPAQUE
        if camera.name in mirrored:
            bare |= _else_than(mirrored[camera.name], drawn, around.undecided[camera.name])
        speck, gap = 0.01 * camera.width, 0.02 * camera.width
        found[camera.name] = voting.tidy(hidden & bare, speck, gap) & hidden
    return found


def _else_than(image: np.ndarray, drawn: Rendering, undecided: np.ndarray) -> np.ndarray:
    """bool [H, W]: before the image stands what no photograph shows, and no reference put there, or nothing does."""
    depth, new = (each.cpu().numpy() for each in (drawn.depth, drawn.features[..., 0] > 0.5))
    before = (depth < (1 - EDGE) * image) & ~new & undecided
    return np.isfinite(image) & (before | (image < (1 - EDGE) * depth))


def haze(
    gaussians: Gaussians, new: Tensor, around: Surroundings, found: Mapping[str, np.ndarray], leak: float
) -> Tensor:
    """bool [N]: old Gaussians that show mostly where nothing else covers C."""
    return voting.leaking(gaussians, around.cameras, found, leak) & ~new


@torch.no_grad()
def completed(
    references: Sequence[Reference], gaussians: Gaussians, around: Surroundings
) -> list[tuple[Witness, np.ndarray]]:
    """The completed views as witnesses of what they show in C, where Gaussians lie by now, and their pictures."""
    of, found = {view.camera.name: view for view in around.views}, []
    for each in references:
        drawn = rasterizer.render(gaussians, each.camera, sh_degree=0)
        depth = torch.where(drawn.alpha > OPAQUE, drawn.depth, 0.0).cpu().numpy()
        view = of[each.camera.name]
        found.append((replace(view, depth=depth, hidden=view.hidden & ~each.mask), each.image))
    return found


def beside_photographs(around: Surroundings) -> list[Camera]:
    """The cameras from where views are completed: not those without a photograph that look from another side than all
    photographs. What is made up there knows nothing of what stands there, and may hide what photographs show."""
    axis = lambda camera: camera.world_to_camera[2, :3]
    taken = np.stack([axis(camera) for camera in around.cameras if camera.name not in around.blank])
    near = lambda camera: float((taken @ axis(camera)).max()) > np.cos(np.radians(BESIDE))
    return [camera for camera in around.cameras if camera.name not in around.blank or near(camera)]


def barest(cameras: Sequence[Camera], around: Surroundings, found: Mapping[str, np.ndarray]) -> Camera | None:
    """The camera of whose view most is open; None where in each it is too little to count."""
    bare = [c for c in cameras if found[c.name].sum() > ENOUGH * max(around.hidden[c.name].sum(), 1)]
    return max(bare, key=lambda camera: int(found[camera.name].sum()), default=None)


def narrow(mask: np.ndarray) -> bool:
    """Whether what is open, bool [H, W], is nowhere wider than a gap."""
    inside = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return 2 * float(inside.max()) <= NARROW * mask.shape[1]


@torch.no_grad()
def before(gaussians: Gaussians, depth: np.ndarray, reference: Reference, hidden: np.ndarray) -> np.ndarray:
    """bool [H, W]: what a reference draws over what stays, before all that the Gaussians show: the back of a thing of
    which earlier ones drew the front, seen from within.

    Args:
        depth: [H, W] of the reference's surface. hidden: bool [H, W], C.
    """
    drawn = rasterizer.render(gaussians, reference.camera, sh_degree=0)
    shown = torch.where(drawn.alpha > 0.5, drawn.depth, torch.inf).double().cpu().numpy()
    return reference.mask & ~hidden & (depth < (1 - EDGE) * shown)


def beside_edges(depth: np.ndarray, stays: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels just beyond the edge of something nearer, on what stays there: stained by its colour,
    and photographs show them clean.

    Args:
        depth, stays: [H, W] of the completed view, and of the scene as it is.
    """
    nearest = cv2.erode(depth, np.ones((3, 3)))
    return (depth > (1 + EDGE) * nearest) & (np.abs(depth - stays) < EDGE * stays)
