"""Closes a scene where no training view looked: removes unsupported Gaussians and adds a soft backdrop behind the rest.

Beyond the frames of the capture and around its corners a fit has no Gaussians, or some that no photograph supervised.
Views that look there show black holes and blobs. A sphere behind everything, in the blurred colours that lie in about
the same direction, continues the scene softly instead. (What else was measured: docs/results.md#backdrop.)
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

SUPPORT = 0.1  # px, blending weight over all training views that a Gaussian needs to stay
LONGEST = 256  # px, larger side at which training views are rendered
BLOCK = 16  # px, side of the blocks of a training view whose mean colours the backdrop continues
DISKS = 2000  # Gaussians of the sphere: 4.5 degrees from one to the next
SPACING = math.sqrt(4 * math.pi / DISKS)  # radians between neighbouring disks
# Radius of the sphere over the distance of the farthest Gaussian or camera. Closer, disks at a frame's edge would stand
# in front of what they must lie behind.
CLEARANCE = 1.5
VIEW_BLUR = 0.06  # radians around a block of a view in which its colour is hardly mixed with others
POINT_BLUR = 0.2  # the same around a point that no view shows: a single stray one must not colour its neighbourhood


class Patches(NamedTuple):
    """Coloured rays: S patches, each seen from an origin along a direction; float64.

    Attributes:
        origins, directions, colors: [S, 3].
        blur: [S] radians around the ray in which the colour is hardly mixed with others.
    """

    origins: np.ndarray
    directions: np.ndarray
    colors: np.ndarray
    blur: np.ndarray


def complete_scene(scenes: Sequence[Gaussians], cameras: Sequence[Camera]) -> list[Gaussians]:
    """The supported Gaussians of each scene, in their order, followed by the backdrop of the first scene.

    Pixels that the training views see keep their colours: what is removed does not show there, and what is added lies
    behind everything.

    Args:
        scenes: states of one scene, the final one first.
        cameras: its training views; without any, the scenes come back unchanged.
    """
    if not cameras:
        return list(scenes)
    small = [shrink_camera(camera, LONGEST) for camera in cameras]
    pixels = [full.width * full.height / (s.width * s.height) for full, s in zip(cameras, small, strict=True)]
    supported = [blending_weights(gaussians, small, pixels) > SUPPORT for gaussians in scenes]
    kept = [gaussians.map(lambda p, stays=stays: p[stays]) for gaussians, stays in zip(scenes, supported, strict=True)]
    patches = patches_of_views(scenes[0], small)
    if not len(kept[0]) or not len(patches.colors):
        return list(scenes)
    removed = scenes[0].map(lambda p: p[~supported[0]])
    behind = build_backdrop(kept, cameras, concatenate([patches, patches_outside_views(removed, cameras)]))
    return [each.zip_map(behind, lambda a, b: torch.cat([a, b.to(a)])) for each in kept]


def blending_weights(gaussians: Gaussians, cameras: Sequence[Camera], pixels: Sequence[float]) -> torch.Tensor:
    """[N] the blending weight of each Gaussian, summed over the pixels of all views.

    Args:
        pixels: for each camera, how many pixels of the full view one of its pixels stands for.
    """
    total = gaussians.means.new_zeros(len(gaussians))
    for camera, share in zip(cameras, pixels, strict=True):
        ones = total.new_ones(camera.height, camera.width, 1)
        total += share * rasterizer.accumulate(gaussians, camera, ones)[:, 0]
    return total


@torch.no_grad()
def patches_of_views(gaussians: Gaussians, cameras: Sequence[Camera]) -> Patches:
    """The blocks of all rendered views."""
    renders = ((camera, rasterizer.render(gaussians, camera)) for camera in cameras)
    return concatenate([_blocks(c, r.color.double().cpu().numpy(), r.alpha.double().cpu().numpy()) for c, r in renders])


def patches_outside_views(gaussians: Gaussians, cameras: Sequence[Camera]) -> Patches:
    """The unsupported Gaussians that lie in no view's frame, as seen from the middle of the cameras.

    These are points that the scene brought, coloured by photographs that are not among the training views. As Gaussians
    they show as blobs, since nothing formed a surface of them, but their colours are true. Unsupported Gaussians within
    a frame lie behind or inside something and tell nothing.
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
    """All patches in one."""
    return Patches(*(np.concatenate(column) for column in zip(*patches, strict=True)))


def shrink_camera(camera: Camera, longest: int) -> Camera:
    """The same view with no side longer than `longest` px."""
    share = min(1.0, longest / max(camera.width, camera.height))
    return camera.resized(max(1, round(camera.width * share)), max(1, round(camera.height * share)))


def _blocks(camera: Camera, color: np.ndarray, alpha: np.ndarray) -> Patches:
    """The blocks of a view, `BLOCK` px a side, at least half of which is covered."""
    rows, columns = (np.arange(0, size, BLOCK) for size in color.shape[:2])
    total = lambda values: np.add.reduceat(np.add.reduceat(values, rows, 0), columns, 1)
    covered, size = total(alpha), total(np.ones_like(alpha))
    chosen = covered > 0.5 * size
    colors = total(color)[chosen] / covered[chosen][:, None]
    rays = (total(geometry.pixel_rays(camera)) / size[..., None])[chosen] @ camera.world_to_camera[:3, :3]
    blur = np.full(len(colors), VIEW_BLUR)
    return Patches(np.broadcast_to(camera.center, colors.shape), rays, colors.clip(0, 1), blur)


def build_backdrop(scenes: Sequence[Gaussians], cameras: Sequence[Camera], patches: Patches) -> Gaussians:
    """`DISKS` soft disks, float32 on the CPU, on a sphere behind all Gaussians of the scenes and all cameras.

    A disk's colour is a mean of the patches' colours, weighted by how near a patch's ray meets the sphere.
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
    # The shortest rotation from z to the direction of the disk; for -z any half turn will do.
    quaternions = np.concatenate([1 + disks[:, 2:], np.cross([0.0, 0.0, 1.0], disks)], 1)
    logits = np.full(DISKS, math.log(0.98 / 0.02))
    arrays = (middle + radius * disks, quaternions, np.log(np.tile(sizes, (DISKS, 1))), logits, sh)
    return Gaussians(*(torch.from_numpy(array).float() for array in arrays), antialiased=scenes[0].antialiased)


def _fibonacci_sphere(count: int) -> np.ndarray:
    """[count, 3] unit vectors about equally far apart, on a spiral of the golden ratio."""
    index = np.arange(count) + 0.5
    height, turn = 1 - 2 * index / count, math.pi * (1 + math.sqrt(5)) * index
    level = np.sqrt(1 - height**2)
    return np.stack([level * np.cos(turn), level * np.sin(turn), height], 1)


def _intersect_unit_sphere(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """[S, 3] unit vectors: where rays that start inside the unit sphere leave it.

    Args:
        origins, directions: [S, 3]; a ray without length gives its origin.
    """
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions / np.maximum(length, np.finfo(np.float64).tiny)
    along = (origins * directions).sum(1)
    far = np.sqrt(along**2 + 1 - (origins**2).sum(1)) - along
    return origins + far[:, None] * directions


def _interpolate_colors(disks: np.ndarray, hits: np.ndarray, colors: np.ndarray, blur: np.ndarray) -> np.ndarray:
    """[D, 3] colours at the unit vectors `disks` [D, 3]: means of `colors` [S, 3], weighted by distance to the power -6
    from `hits` [S, 3], and equally within `blur` [S] radians."""
    mixed = np.empty_like(disks)
    for part in np.array_split(np.arange(len(disks)), 10):  # all at once would take gigabytes
        squared_distance = 2 - 2 * disks[part] @ hits.T
        weight = 1 / (squared_distance + blur**2) ** 3
        mixed[part] = weight @ colors / weight.sum(1, keepdims=True)
    return mixed
