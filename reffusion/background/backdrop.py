"""The backdrop: a sphere of soft disks that closes the scene in directions in which no training view looked.

Outside the image areas of all training views a fit has no Gaussians, or Gaussians that no photograph supervised. New
views that look in these directions show black holes and blobs. Gaussians that the training views hardly see are
therefore removed, and the sphere is added behind everything. Each of its disks has the blurred color of the surfaces
that lie in about the same direction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from reffusion import geometry
from reffusion.splat import rasterizer
from reffusion.splat.conventions import SH0
from reffusion.types import Camera, Gaussians

SUPPORT = 0.1  # px, total blending weight in all training views above which a Gaussian is supported and stays
LONGEST = 256  # px, larger side at which training views are rendered
BLOCK = 16  # px, side of the blocks of a training view whose mean colors determine the colors of the backdrop
DISKS = 2000  # number of Gaussians of the sphere: neighbors are 4.5 degrees apart
SPACING = math.sqrt(4 * math.pi / DISKS)  # radians between neighboring disks
# Radius of the sphere, divided by the distance of the farthest Gaussian or camera from the middle of the cameras. On a
# smaller sphere, disks at the edge of a training view would lie in front of Gaussians that they must lie behind.
CLEARANCE = 1.5
VIEW_BLUR = 0.06  # radians, `Patches.blur` of a block of a view
POINT_BLUR = 0.2  # radians, `Patches.blur` of a point that no view shows: one stray point must not color a whole area


class Patches(NamedTuple):
    """S colored patches of the scene, each given by the ray along which it is seen; float64.

    Attributes:
        origins: [S, 3], where the rays start, in world coordinates.
        directions: [S, 3], directions of the rays, of any length.
        colors: [S, 3] in [0, 1].
        blur: [S], radius in radians around the ray. When colors are averaged, the weight of the patch is about
            constant within this radius, and decreases with the sixth power of the distance beyond.
    """

    origins: np.ndarray
    directions: np.ndarray
    colors: np.ndarray
    blur: np.ndarray


def complete_scene(scenes: Sequence[Gaussians], cameras: Sequence[Camera], extension: Gaussians) -> list[Gaussians]:
    """Return each scene without its unsupported Gaussians, with an extension and the backdrop of the first scene.

    A Gaussian is supported if its blending weight, summed over all pixels of the training views, exceeds `SUPPORT`. For
    each scene this is the weight in its own renderings. The training views look the same as before: the removed
    Gaussians hardly contribute to them, and the backdrop lies behind everything.

    Args:
        scenes: states of one scene (e.g. after `distill` and after `initialize`), the final state first.
        cameras: the training views.
        extension: Gaussians beyond what the training views show, e.g. of planes that go on there
            (`inpaint.plane_extension`); there may be none.

    Returns:
        The completed scenes, in the order of `scenes`: first the supported Gaussians in their order, then the extension
        and the backdrop. The scenes are returned as they are if there are no cameras, or if the first scene shows
        nothing in them.
    """
    if not cameras:
        return list(scenes)
    small = [camera.shrunk(LONGEST) for camera in cameras]
    pixels = [full.width * full.height / (s.width * s.height) for full, s in zip(cameras, small, strict=True)]
    supported = [blending_weights(gaussians, small, pixels) > SUPPORT for gaussians in scenes]
    kept = [gaussians.map(lambda p, stays=stays: p[stays]) for gaussians, stays in zip(scenes, supported, strict=True)]
    patches = patches_of_views(scenes[0], small)
    if not len(kept[0]) or not len(patches.colors):
        return list(scenes)
    removed = scenes[0].map(lambda p: p[~supported[0]])
    patches = concatenate([patches, patches_outside_views(removed, cameras)])
    join = lambda first, second: first.zip_map(second, lambda a, b: torch.cat([a, b.to(a)]))
    extended = [join(each, extension) for each in kept]
    behind = build_backdrop(extended, cameras, patches)
    return [join(each, behind) for each in extended]


def blending_weights(gaussians: Gaussians, cameras: Sequence[Camera], pixels: Sequence[float]) -> torch.Tensor:
    """Return [N], the blending weight of each Gaussian, summed over the pixels of all views.

    Args:
        cameras: the views, at reduced resolution.
        pixels: for each camera, the number of pixels of the full-size view that one pixel of the camera represents. The
            result is in pixels of the full-size views.
    """
    total = gaussians.means.new_zeros(len(gaussians))
    for camera, share in zip(cameras, pixels, strict=True):
        ones = total.new_ones(camera.height, camera.width, 1)
        total += share * rasterizer.accumulate(gaussians, camera, ones)[:, 0]
    return total


@torch.no_grad()
def patches_of_views(gaussians: Gaussians, cameras: Sequence[Camera]) -> Patches:
    """Render the views, at least one, and return their blocks of `BLOCK` x `BLOCK` pixels as patches.

    The color of a patch is the block's mean color, divided by its mean alpha. Blocks with a mean alpha up to 0.5 are
    left out.
    """
    renders = ((camera, rasterizer.render(gaussians, camera)) for camera in cameras)
    return concatenate([_blocks(c, r.color.double().cpu().numpy(), r.alpha.double().cpu().numpy()) for c, r in renders])


def patches_outside_views(gaussians: Gaussians, cameras: Sequence[Camera]) -> Patches:
    """Return the Gaussians whose centers project into the image of no view as patches, seen from the cameras' middle.

    These Gaussians come from the scene's sparse points, whose colors are those of photographs that are not among the
    training views. Renderings of them look like blobs, because no training view supervised them, but their colors are
    correct. Unsupported Gaussians that project into a view are left out: they lie behind or inside a surface, and their
    colors are arbitrary.

    Args:
        gaussians: the unsupported Gaussians (see `complete_scene`).
        cameras: the training views.
    """
    means = gaussians.means.double().cpu().numpy()
    outside = np.ones(len(means), bool)
    for camera in cameras:
        uv, _ = geometry.project(means, camera)
        outside &= ~((uv >= 0) & (uv < (camera.width, camera.height))).all(1)
    colors = 0.5 + SH0 * gaussians.sh[:, 0].double().cpu().numpy()[outside]
    middle, blur = np.mean([camera.center for camera in cameras], axis=0), np.full(len(colors), POINT_BLUR)
    return Patches(np.broadcast_to(middle, colors.shape), means[outside] - middle, colors.clip(0, 1), blur)


def concatenate(patches: Sequence[Patches]) -> Patches:
    """Concatenate sets of patches, at least one."""
    return Patches(*(np.concatenate(column) for column in zip(*patches, strict=True)))


def _blocks(camera: Camera, color: np.ndarray, alpha: np.ndarray) -> Patches:
    """Return the `BLOCK` px blocks of a view with a mean alpha above 0.5 as patches; `color` is rendered over black."""
    rows, columns = (np.arange(0, size, BLOCK) for size in color.shape[:2])
    total = lambda values: np.add.reduceat(np.add.reduceat(values, rows, 0), columns, 1)
    covered, size = total(alpha), total(np.ones_like(alpha))
    chosen = covered > 0.5 * size
    colors = total(color)[chosen] / covered[chosen][:, None]
    rays = (total(geometry.pixel_rays(camera)) / size[..., None])[chosen] @ camera.world_to_camera[:3, :3]
    blur = np.full(len(colors), VIEW_BLUR)
    return Patches(np.broadcast_to(camera.center, colors.shape), rays, colors.clip(0, 1), blur)


def build_backdrop(scenes: Sequence[Gaussians], cameras: Sequence[Camera], patches: Patches) -> Gaussians:
    """Return the backdrop: `DISKS` soft disks on a sphere around all Gaussians and cameras, float32 on the CPU.

    The color of a disk is the weighted mean of the patches' colors. The weight of a patch is larger the nearer to the
    disk the patch's ray meets the sphere.

    Args:
        scenes: Gaussians inside the sphere. The first scene (required) sets the harmonics and `antialiased`.
        cameras: the cameras that lie inside the sphere. Its center is the mean of their centers.
    """
    centers = np.stack([camera.center for camera in cameras])
    middle = centers.mean(0)
    means = [gaussians.means.double().cpu().numpy() for gaussians in scenes if len(gaussians)]
    radius = CLEARANCE * max(np.linalg.norm(points - middle, axis=1).max() for points in (*means, centers))
    disks = _fibonacci_sphere(DISKS)
    hits = _intersect_unit_sphere((patches.origins - middle) / radius, patches.directions)
    colors = _interpolate_colors(disks, hits, patches.colors, patches.blur)
    sh = np.zeros((DISKS, scenes[0].sh.shape[1], 3))
    sh[:, 0] = (colors - 0.5) / SH0
    sizes = radius * SPACING * np.array([0.8, 0.8, 0.05])
    # The shortest rotation from the z axis to the direction of the disk; no disk lies exactly at -z, where this is 0.
    quaternions = np.concatenate([1 + disks[:, 2:], np.cross([0.0, 0.0, 1.0], disks)], 1)
    logits = np.full(DISKS, math.log(0.98 / 0.02))
    arrays = (middle + radius * disks, quaternions, np.log(np.tile(sizes, (DISKS, 1))), logits, sh)
    return Gaussians(*(torch.from_numpy(array).float() for array in arrays), antialiased=scenes[0].antialiased)


def _fibonacci_sphere(count: int) -> np.ndarray:
    """Return [count, 3] unit vectors that are about evenly spaced, on a spiral of the golden ratio."""
    index = np.arange(count) + 0.5
    height, turn = 1 - 2 * index / count, math.pi * (1 + math.sqrt(5)) * index
    level = np.sqrt(1 - height**2)
    return np.stack([level * np.cos(turn), level * np.sin(turn), height], 1)


def _intersect_unit_sphere(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the points [S, 3] where rays from inside the unit sphere leave the sphere; directions have any length."""
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    # for a direction of length 0 the result is the ray's origin
    directions = directions / np.maximum(length, np.finfo(np.float64).tiny)
    along = (origins * directions).sum(1)
    far = np.sqrt(along**2 + 1 - (origins**2).sum(1)) - along
    return origins + far[:, None] * directions


def _interpolate_colors(disks: np.ndarray, hits: np.ndarray, colors: np.ndarray, blur: np.ndarray) -> np.ndarray:
    """Return the disks' colors [D, 3]; `disks` and `hits` (where patches' rays meet the sphere) are unit vectors."""
    mixed = np.empty_like(disks)
    for part in np.array_split(np.arange(len(disks)), 10):  # all at once would take gigabytes
        squared_distance = 2 - 2 * disks[part] @ hits.T
        # It decreases with the sixth power of the distance, and is about constant within `blur` radians.
        weight = 1 / (squared_distance + blur**2) ** 3
        mixed[part] = weight @ colors / weight.sum(1, keepdims=True)
    return mixed
