"""Division of inserted surfaces among several references with depth maps.

Where more than one reference shows the same surface, one of them is chosen, and its pixels become Gaussians. This
concerns the pixels outside C (the object's mask) where a reference draws an inserted object over the remaining scene.
"""

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

SAME_NORMAL = 0.85  # smallest cosine between the normals of the same surface in two references
MIN_COSINE = 0.05  # smallest cosine between normal and view that is counted: the footprint stays finite
UNCHANGED = 12  # levels of 255: largest difference between two pictures that show the same
EDGE = np.ones((3, 3), np.uint8)  # window of 3 x 3 px, because an edge is located to within a pixel


@dataclass(frozen=True)
class Share:
    """The part of the inserted surfaces that one of several references adds to the scene.

    Attributes:
        drawn: bool [H, W], the pixels outside C that become Gaussians.
        ceded: bool [H, W], all other pixels of the reference's mask outside C whose depth is known. Another reference
            adds their surface, or sees past it, or they look like the photograph.
    """

    drawn: np.ndarray
    ceded: np.ndarray


@dataclass(frozen=True)
class ReferenceSurface:
    """The surface that a reference shows.

    Attributes:
        camera: the view of the reference.
        depth: [H, W], camera z in world units; 0 where unknown.
        pixels: bool [H, W], the pixels that the reference would add if it were the only one.
    """

    camera: Camera
    depth: np.ndarray
    pixels: np.ndarray

    @cached_property
    def normals(self) -> np.ndarray:
        """[H, W, 3], unit normals of the surface, toward the camera."""
        return surface_normals(self.depth, self.camera)

    @cached_property
    def footprints(self) -> np.ndarray:
        """[H, W], the length of a pixel's footprint on the surface along its longest direction, in world units.

        The length grows with depth and with the slant of the surface; it is infinite where depth is unknown.
        """
        rays = geometry.unproject(np.ones_like(self.depth), self.camera) - self.camera.center
        direction = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        cosine = np.abs((direction * self.normals).sum(-1)).clip(MIN_COSINE)
        smooth = cv2.medianBlur((self.depth / cosine).astype(np.float32), 3)  # normals are noisy
        return np.where(self.depth > 0, smooth, np.inf) / np.sqrt(self.camera.fx * self.camera.fy)


def share_surfaces(
    remaining: Gaussians, references: Sequence[Reference], background: Background, completion: CompletionSettings
) -> dict[str, Share]:
    """Decide for each reference with a depth map which pixels outside C (the object's mask) it adds to the scene.

    Without this division the first reference would add every surface that it shows. A surface that it sees obliquely
    would be coarse, with one pixel as a long smear, and would prevent another reference from adding it sharply.

    Args:
        remaining: the Gaussians of the scene without the object.
        references: completed views, in the order in which they are added.
        background: the photographs and masks.
        completion: settings for the depth around the hole, to which the depth maps are aligned.

    Returns:
        View name -> its share, for the references with a depth map; empty if fewer than two have one.

    Raises:
        ValueError: as `align_reference_depth`.
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
    """Return [H, W], the depth map of a reference, aligned to the depth of the scene; 0 where unknown.

    The result is camera z in world units. The reference must have a depth map, of any scale and offset.

    Raises:
        ValueError: the depth map does not fit the scene, or too little depth is known, see `alignment.align_either`.
    """
    assert reference.depth is not None
    camera, rendering = reference.camera, rasterizer.render(remaining, reference.camera, sh_degree=0)
    hints = Hints(photographed_depth=background.photographed_depth(camera))
    mask = background.masks[camera.name]
    view = background_depth.extract_depth(rendering, camera, reference.mask, mask, completion, hints)
    depth, _ = alignment.align_either(reference.depth, view.depth, view.known)
    return np.where(np.isfinite(depth), depth, 0.0)


def select_finest(surfaces: Sequence[ReferenceSurface]) -> list[np.ndarray]:
    """Return for each reference bool [H, W], the pixels that it adds to the scene.

    Each surface is added by the reference that shows it with the smallest footprint (the length of a pixel on the
    surface); between equal footprints the earlier reference wins. A pixel whose surface another reference sees past is
    not added.
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
    """Test whether another reference shows the surface at given points, or sees past it.

    Two references show the same surface where depths and normals agree. The normals tell two faces of an object apart:
    beside the edge between them both have the same depth. Where it is uncertain whether surfaces are the same, both
    references add them, which does less harm than a gap.

    Args:
        points: [P, 3], points of a reference's surface.
        normals: [P, 3], unit normals at the points.
        other: the surface of the other reference.

    Returns:
        Three arrays [P]: bool, True where the other reference would add the same surface; bool, True where the other
        reference sees past the point; and the other reference's footprint at the pixel that shows the point, which has
        a meaning only where the first array is True.
    """
    near, far = cv2.erode(np.where(other.depth > 0, other.depth, np.inf), EDGE), cv2.dilate(other.depth, EDGE)
    uv, z = geometry.project(points, other.camera)
    near, inside = geometry.sample_nearest(near, uv)
    maps = far, other.pixels, other.footprints, other.normals
    far, covered, footprint, normal = (geometry.sample_nearest(each, uv)[0] for each in maps)
    inside &= (z > 0) & (far > 0)
    same_depth = (z > (1 - geometry.SAME_SURFACE) * near) & (z < (1 + geometry.SAME_SURFACE) * far)
    same = inside & covered & same_depth & ((normal * normals).sum(1) > SAME_NORMAL)
    return same, inside & (z < (1 - geometry.OTHER_SURFACE) * near), footprint


def unchanged_rim(image: np.ndarray, photo: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the pixels along the border of an inserted region that look like the photograph.

    Detected changes extend a little beyond the inserted object. The depth of these extra pixels belongs to another
    surface, so they must not be added.

    Args:
        image: uint8 [H, W, 3], the completed view.
        photo: uint8 [H, W, 3], the photograph of the same view.
        drawn: bool [H, W], the pixels that were drawn over the photograph.
    """
    alike = drawn & (np.abs(image.astype(np.int16) - photo).max(-1) <= UNCHANGED)
    alike = ndimage.binary_opening(alike, np.ones((2, 2)))
    return alike & ndimage.binary_propagation(~drawn, mask=alike | ~drawn)
