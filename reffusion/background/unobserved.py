"""Which pixels behind an object are decided: there other photographs show what is to be seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from reffusion.background.mirrors import Mirror, imaged
from reffusion.background.plane import BEFORE, Plane
from reffusion.background.visibility import (
    OPAQUE,
    SURFACE,
    Witness,
    smoothed_surface,
    surface_range,
    votes,
    with_photographed_depth,
    without_slivers,
)
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

BESIDE = 0.03  # of the image's width: how far around a plane's patch it is compared with what is shown
ROUGHEST = 0.06  # of the depth: a wider range around a pixel is no rough surface, but a depth edge
WITNESSES = 3  # views that must show a surface for it to be there, though most around it is undecided
AGREES = 0.6  # share of the pixels beside a plane's patch that must lie on it, of those where nothing stands before it
OPEN = 0.3  # the same, of all of them


@dataclass(frozen=True)
class Behind:
    """What one view shows with the object gone.

    Attributes:
        undecided: bool [H, W], inside C: no photograph tells what is to be seen there.
        continued: [H, W], depth of the plane that goes on there, or of a mirror image; inf where there is none, or
            outside `undecided`.
        depth, alpha: [H, W] float64, as rendered; outside the mask the photographed depth.
        planes: depth [H, W] of each of these, everywhere; inf where a ray does not meet it.
        witnessed: bool [H, W], inside C: a few views show the surface that is rendered there; specks are left out.
    """

    undecided: np.ndarray
    continued: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray
    planes: tuple[np.ndarray, ...]
    witnessed: np.ndarray


@torch.no_grad()
def behind(
    remaining: Gaussians,
    camera: Camera,
    hidden: np.ndarray,
    views: Sequence[Witness],
    planes: Sequence[Plane],
    mirrors: Sequence[Mirror] = (),
) -> Behind:
    """A pixel of C is decided if its ray meets no continuation of a surface before one that other views show,
    unmasked, at that depth and from the same side: a quarter of those in which it or something before it is seen. What
    lies beneath a surface in nearly all of them is what the fit left there.

    Args:
        remaining: the M Gaussians without the object.
        hidden: bool [H, W], C of that view.
        mirrors: of things around: a pixel in which something's image stands before what is rendered is not decided.
    """
    drawn = rasterizer.render(remaining, camera, sh_degree=0)
    depth, alpha = (t.double().cpu().numpy() for t in (drawn.depth, drawn.alpha))
    rows, columns = np.nonzero(hidden & (alpha > OPAQUE))
    undecided, witnessed = hidden.copy(), np.zeros_like(hidden)
    if len(rows):
        points, normals = (each[rows, columns] for each in smoothed_surface(depth, camera))
        said = votes(points, views, normals)
        undecided[rows, columns] = ~said.shown
        witnessed[rows, columns] = said.shown & (said.seen >= WITNESSES)
    depth = with_photographed_depth(depth, camera, views)
    hides, reach, onward = np.zeros_like(hidden), np.full(hidden.shape, np.inf), []
    for plane in planes:
        at = plane.depth(camera)
        before = plane.on(plane.goes_on, at, camera, hidden & (at < BEFORE * np.where(depth > 0, depth, np.inf)))
        # Where nothing is known the plane goes on too, but not behind something that stands before it.
        beneath = plane.on(plane.within, at, camera, undecided & ((at < depth / BEFORE) | (alpha <= OPAQUE)))
        if _grows_out_of(before | beneath, plane, at, camera, depth, ~hidden & (alpha > OPAQUE)):
            hides |= before
            onward.append(at)
            reach = np.where(before | beneath, np.minimum(reach, at), reach)
    if mirrors:
        image = imaged(mirrors, camera, hidden, views)
        hides |= image.supposed < BEFORE * np.where((depth > 0) & (alpha > OPAQUE), depth, np.inf)
        onward.append(image.depth)
        rather = (hides | undecided) & (image.supposed < (1 + SURFACE) * reach)  # a plane may cut through a round thing
        reach = np.where(rather, image.supposed, reach)
    undecided = without_slivers(undecided | hides) & hidden
    witnessed = without_slivers(witnessed & ~hides & ~_beneath(planes, camera, depth, hidden)) & hidden
    return Behind(undecided, np.where(undecided, reach, np.inf), depth, alpha, tuple(onward), witnessed)


def _beneath(planes: Sequence[Plane], camera: Camera, depth: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """bool [H, W]: of the pixels asked, those that show what lies beneath a plane, or is mirrored in it."""
    found = np.zeros_like(asked)
    for plane in planes:
        at = plane.depth(camera)
        found |= plane.on(plane.pit | plane.within | plane.seen, at, camera, asked & (at < BEFORE * depth))
    return found


def _grows_out_of(
    patch: np.ndarray, plane: Plane, at: np.ndarray, camera: Camera, depth: np.ndarray, known: np.ndarray
) -> bool:
    """Does the plane, at depth `at`, lie at the rendered depth around the patch of it (bool [H, W]), or do most views
    show it there? One that only cuts through what stands there does not. Where views look through the plane, nothing
    is compared."""
    if not patch.any():
        return False
    reach = max(3, round(BESIDE * patch.shape[1]))
    beside = cv2.dilate(patch.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
    beside &= known & np.isfinite(at)
    beside &= ~plane.on(plane.free, at, camera, beside)
    if not beside.any():
        return False
    nearest, farthest = surface_range(depth)
    lies = (at > nearest * (1 - SURFACE)) & (at < farthest * (1 + SURFACE)) & (np.abs(at - depth) < ROUGHEST * depth)
    # One view may be wrong about rough ground, or look through what shines: others tell.
    lies |= plane.on(plane.seen, at, camera, beside)
    wrong = ~lies & (depth > at)  # where something stands before the plane it may go on
    share, against = float(lies[beside].mean()), float(wrong[beside].mean())
    return share > OPEN and share > AGREES * (share + against)
