"""Several references with depth maps: decide which one draws a surface that more than one of them shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from scipy import ndimage

from reffusion import geometry
from reffusion.background.model import Background
from reffusion.depth import alignment, background_depth
from reffusion.depth.background_depth import CompletionSettings, Hints
from reffusion.gaussians.surfels import surface_normals
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, Reference

SAME_DEPTH = 0.015  # relative depth within which two references show the same surface
SAME_NORMAL = 0.85  # least cosine between their normals there
PAST = 0.03  # relative depth by which a reference sees past what another draws
MIN_COSINE = 0.05  # between surface normal and view: a more oblique surface counts as this oblique
UNCHANGED = 12  # of 255: largest difference between pictures that show the same
EDGE = np.ones((3, 3), np.uint8)  # px: the position of an edge is accurate to a pixel


@dataclass(frozen=True)
class Share:
    """Which pixels of its depth map one of several references adds to the scene.

    Attributes:
        drawn: bool [H, W], pixels that become Gaussians.
        ceded: bool [H, W], pixels that do not: another reference adds them, or the scene shows them already.
    """

    drawn: np.ndarray
    ceded: np.ndarray


@dataclass(frozen=True)
class ReferenceSurface:
    """The surface that a reference shows.

    Attributes:
        camera: its view. depth: [H, W], 0 where unknown. pixels: bool [H, W], what the reference would draw.
    """

    camera: Camera
    depth: np.ndarray
    pixels: np.ndarray

    @cached_property
    def normals(self) -> np.ndarray:
        """[H, W, 3], towards the camera."""
        return surface_normals(self.depth, self.camera)

    @cached_property
    def footprints(self) -> np.ndarray:
        """[H, W], the width of a pixel on the surface, in its widest direction, in world units; infinite where depth is
        unknown."""
        rays = geometry.unproject(np.ones_like(self.depth), self.camera) - self.camera.center
        direction = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        cosine = np.abs((direction * self.normals).sum(-1)).clip(MIN_COSINE)
        smooth = cv2.medianBlur((self.depth / cosine).astype(np.float32), 3)  # normals are noisy
        return np.where(self.depth > 0, smooth, np.inf) / np.sqrt(self.camera.fx * self.camera.fy)


def share_surfaces(
    remaining: Gaussians, references: Sequence[Reference], background: Background, completion: CompletionSettings
) -> dict[str, Share]:
    """View name -> its share, of the references with a depth map; empty where there are fewer than two.

    Each alone would draw all that it shows. What it shows obliquely is coarse, one pixel is a long smear there, and it
    would keep out what another reference shows sharply.

    Args:
        remaining: the Gaussians that remain.
        references: in the order in which they are drawn.
    """
    with_depth = [each for each in references if each.depth is not None]
    if len(with_depth) < 2:
        return {}
    surfaces, known = [], []
    for each in with_depth:
        name, depth = each.camera.name, align_reference_depth(remaining, each, background, completion)
        over = each.mask & ~background.masks[name]
        known.append(over & (depth > 0))
        rim = unchanged_rim(each.image, background.photos[name], over)
        surfaces.append(ReferenceSurface(each.camera, depth, known[-1] & ~rim))
    finest = select_finest(surfaces)
    return {
        each.camera.name: Share(own, pixels & ~own) for each, pixels, own in zip(surfaces, known, finest, strict=True)
    }


@torch.no_grad()
def align_reference_depth(
    remaining: Gaussians, reference: Reference, background: Background, completion: CompletionSettings
) -> np.ndarray:
    """[H, W] the depth map of a reference in world units; 0 where unknown."""
    assert reference.depth is not None
    camera, rendering = reference.camera, rasterizer.render(remaining, reference.camera, sh_degree=0)
    hints = Hints(photographed_depth=background.photographed_depth(camera))
    mask = background.masks[camera.name]
    view = background_depth.extract_depth(rendering, camera, reference.mask, mask, completion, hints)
    depth, _ = alignment.align_either(reference.depth, view.depth, view.known)
    return np.where(np.isfinite(depth), depth, 0.0)


def select_finest(surfaces: Sequence[ReferenceSurface]) -> list[np.ndarray]:
    """bool [H, W] of each: the pixels that it draws.

    A surface is drawn by the reference that shows it with the smallest footprint, by the earlier of two alike; and
    nothing is drawn where another reference sees past it.
    """
    found = []
    for i, each in enumerate(surfaces):
        points, own = geometry.unproject(each.depth, each.camera)[each.pixels], each.footprints[each.pixels]
        finest = np.ones(len(points), bool)
        for j, other in enumerate(surfaces):
            if i != j:
                same, past, theirs = cross_visibility(points, each.normals[each.pixels], other)
                finest &= ~past & ~(same & ((theirs < own) | (theirs == own) & (j < i)))
        pixels = each.pixels.copy()
        pixels[each.pixels] = finest
        found.append(pixels)
    return found


def cross_visibility(
    points: np.ndarray, normals: np.ndarray, other: ReferenceSurface
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of points [P, 3] with normals [P, 3]: whether another reference would draw the same surface there, bool [P];
    whether it sees past them, bool [P]; and its footprint there, [P].

    Beyond an edge the next side of a thing is as near, but faces elsewhere: it is another surface. Where this is
    uncertain both draw, which does less harm than a gap.
    """
    near, far = cv2.erode(np.where(other.depth > 0, other.depth, np.inf), EDGE), cv2.dilate(other.depth, EDGE)
    uv, z = geometry.project(points, other.camera)
    near, inside = geometry.sample_nearest(near, uv)
    maps = far, other.pixels, other.footprints, other.normals
    far, covered, footprint, normal = (geometry.sample_nearest(each, uv)[0] for each in maps)
    inside &= (z > 0) & (far > 0)
    same_depth = (z > (1 - SAME_DEPTH) * near) & (z < (1 + SAME_DEPTH) * far)
    same = inside & covered & same_depth & ((normal * normals).sum(1) > SAME_NORMAL)
    return same, inside & (z < (1 - PAST) * near), footprint


def unchanged_rim(image: np.ndarray, photo: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels at the border of what was drawn over a photograph, bool [H, W], that look like the
    photograph; both pictures uint8 [H, W, 3].

    Detected changes extend a little too far, and depth there belongs to something else.
    """
    alike = drawn & (np.abs(image.astype(np.int16) - photo).max(-1) <= UNCHANGED)
    alike = ndimage.binary_opening(alike, np.ones((2, 2)))
    parts, _ = ndimage.label(alike | ~drawn)
    return alike & np.isin(parts, np.unique(parts[~drawn]))
