"""Of several references that bring their depth: which one draws a surface that more than one of them shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from scipy import ndimage

from reffusion import geometry
from reffusion.depth import alignment, background_depth
from reffusion.depth.background_depth import Completion, Hints
from reffusion.gaussians.surfels import surface_normals
from reffusion.initialize.unprojection import Surroundings
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, Reference

SAME = 0.015  # relative depth within which two references show the same surface
ALONG = 0.85  # cosine between their normals there, at least
PAST = 0.03  # relative depth by which one looks past where another draws
GRAZING = 0.05  # least cosine between surface and view that is told apart
ALIKE = 12  # levels of 255 up to which two pictures show the same
BESIDE = np.ones((3, 3), np.uint8)  # px: an edge lies where it is only to a pixel


@dataclass(frozen=True)
class Share:
    """What one of several references draws over what stays, of the pixels whose depth it brings.

    Attributes:
        draws, leaves: bool [H, W], the pixels that it draws, and those that it leaves to others, or as they are.
    """

    draws: np.ndarray
    leaves: np.ndarray


@dataclass(frozen=True)
class Shown:
    """A reference's surfaces.

    Attributes:
        camera: its view. depth: [H, W], 0 where it brings none. pixels: bool [H, W], what it would draw.
    """

    camera: Camera
    depth: np.ndarray
    pixels: np.ndarray

    @cached_property
    def normals(self) -> np.ndarray:
        """[H, W, 3], towards the camera."""
        return surface_normals(self.depth, self.camera)

    @cached_property
    def widths(self) -> np.ndarray:
        """[H, W], how wide a pixel is on the surface, where it is widest, in the frame's unit; infinite where no depth
        is told."""
        rays = geometry.unproject(np.ones_like(self.depth), self.camera) - self.camera.center
        along = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        cosine = np.abs((along * self.normals).sum(-1)).clip(GRAZING)
        smooth = cv2.medianBlur((self.depth / cosine).astype(np.float32), 3)  # normals are unsure
        return np.where(self.depth > 0, smooth, np.inf) / np.sqrt(self.camera.fx * self.camera.fy)


def shares(
    remaining: Gaussians, references: Sequence[Reference], around: Surroundings, how: Completion
) -> dict[str, Share]:
    """View name -> its share, of the references that bring their depth; none where fewer than two do.

    Each by itself draws all that it shows, and what it shows from the side is coarse: one pixel is a long smear there,
    and keeps out what another would show sharply.

    Args:
        remaining: the Gaussians left.
        references: in the order in which they are drawn.
    """
    bring = [each for each in references if each.depth is not None]
    if len(bring) < 2:
        return {}
    shown, told = [], []
    for each in bring:
        name, depth = each.camera.name, aligned(remaining, each, around, how)
        over = each.mask & ~around.hidden[name]
        told.append(over & (depth > 0))
        shown.append(Shown(each.camera, depth, told[-1] & ~unchanged_rim(each.image, around.photos[name], over)))
    shared = zip(shown, told, finest(shown), strict=True)
    return {each.camera.name: Share(draws, pixels & ~draws) for each, pixels, draws in shared}


@torch.no_grad()
def aligned(remaining: Gaussians, reference: Reference, around: Surroundings, how: Completion) -> np.ndarray:
    """[H, W] the depth that a reference brings, in the scene's unit; 0 where it says nothing."""
    camera, drawn = reference.camera, rasterizer.render(remaining, reference.camera, sh_degree=0)
    hints = Hints(outer=around.photographed(camera))
    view = background_depth.seen(drawn, camera, reference.mask, around.hidden[camera.name], how, hints)
    depth, _ = alignment.align_either(reference.depth, view.depth, view.known)
    return np.where(np.isfinite(depth), depth, 0.0)


def finest(shown: Sequence[Shown]) -> list[np.ndarray]:
    """bool [H, W] of each: the pixels that it draws. A surface is drawn by the one that shows it most finely, of two
    alike by the earlier; and nothing stands where another looks past it."""
    found = []
    for i, each in enumerate(shown):
        points, mine = geometry.unproject(each.depth, each.camera)[each.pixels], each.widths[each.pixels]
        draws = np.ones(len(points), bool)
        for j, other in enumerate(shown):
            if i != j:
                same, past, theirs = beheld(points, each.normals[each.pixels], other)
                draws &= ~past & ~(same & ((theirs < mine) | (theirs == mine) & (j < i)))
        pixels = each.pixels.copy()
        pixels[each.pixels] = draws
        found.append(pixels)
    return found


def beheld(points: np.ndarray, normals: np.ndarray, other: Shown) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of points [P, 3] with these normals, [P, 3]: whether another reference would draw the same surface there, bool
    [P]; whether it looks past them, bool [P]; and how wide its pixel is there, [P].

    Beyond an edge the next side of a thing is as near: it is another surface, for it faces another way. Where that is
    not sure both draw, which does less harm than a gap.
    """
    near, far = cv2.erode(np.where(other.depth > 0, other.depth, np.inf), BESIDE), cv2.dilate(other.depth, BESIDE)
    uv, z = geometry.project(points, other.camera)
    near, inside = geometry.sample_nearest(near, uv)
    maps = far, other.pixels, other.widths, other.normals
    far, drawn, theirs, facing = (geometry.sample_nearest(each, uv)[0] for each in maps)
    inside &= (z > 0) & (far > 0)
    same = inside & drawn & (z > (1 - SAME) * near) & (z < (1 + SAME) * far) & ((facing * normals).sum(1) > ALONG)
    return same, inside & (z < (1 - PAST) * near), theirs


def unchanged_rim(image: np.ndarray, photo: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels at the border of what was drawn over a photograph, bool [H, W], that look like it, uint8
    [H, W, 3] both: what was found to change reaches a little too far, and depth there is of something else."""
    alike = drawn & (np.abs(image.astype(np.int16) - photo).max(-1) <= ALIKE)
    alike = ndimage.binary_opening(alike, np.ones((2, 2)))
    pieces, _ = ndimage.label(alike | ~drawn)
    return alike & np.isin(pieces, np.unique(pieces[~drawn]))
