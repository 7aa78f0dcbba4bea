"""What no training view saw: Gaussians that none supports leave, and a backdrop closes the scene behind all others.

Where views reach beyond the frames of the capture, or around a corner, a fit has nothing, or points that nothing ever
taught. Both are seen at once, black and in blobs. A sphere around everything, in the blurred colours that lie in about
the same direction, shows a soft continuation instead. (Tried, measured and left out: docs/beyond.md.)
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

SUPPORT = 0.1  # pixels of all training views together that a Gaussian must be worth to stay
LONGEST = 256  # px a side at which the training views are looked at
BLOCK = 16  # px a side of the patches whose mean colours the backdrop continues
DISKS = 2000  # that make the sphere: 4.5 degrees from one to the next
APART = math.sqrt(4 * math.pi / DISKS)  # radians
CLEAR = 1.5  # its radius over the farthest that it must lie behind: less, and disks at a frame's edge stand before it
SEEN_BLUR = 0.06  # radians around a patch of a view in which its colour is hardly mixed
BROUGHT_BLUR = 0.2  # around a point that no view shows: a single stray one must not colour what is around it


class Patches(NamedTuple):
    """S patches of colour, float64.

    Attributes:
        origins, directions, colors: [S, 3], where they are seen from, along which way, and what.
        blur: [S] radians in which the colour is hardly mixed with others.
    """

    origins: np.ndarray
    directions: np.ndarray
    colors: np.ndarray
    blur: np.ndarray


def completed(scenes: Sequence[Gaussians], cameras: Sequence[Camera]) -> list[Gaussians]:
    """The supported Gaussians of each scene, in their order, and behind them the backdrop of the first.

    Pixels that the training views see keep their colours: what leaves is not seen there, and what comes lies behind.

    Args:
        scenes: states of one scene, the finished one first. cameras: its training views; without any, nothing changes.
    """
    if not cameras:
        return list(scenes)
    small = [reduced(camera, LONGEST) for camera in cameras]
    pixels = [of.width * of.height / (at.width * at.height) for of, at in zip(cameras, small, strict=True)]
    supported = [support(gaussians, small, pixels) > SUPPORT for gaussians in scenes]
    kept = [gaussians.map(lambda p, stays=stays: p[stays]) for gaussians, stays in zip(scenes, supported, strict=True)]
    patches = look(scenes[0], small)
    if not len(kept[0]) or not len(patches.colors):
        return list(scenes)
    rest = scenes[0].map(lambda p: p[~supported[0]])
    behind = backdrop(kept, cameras, joined([patches, brought(rest, cameras)]))
    return [each.zip_map(behind, lambda a, b: torch.cat([a, b.to(a)])) for each in kept]


def support(gaussians: Gaussians, cameras: Sequence[Camera], pixels: Sequence[float]) -> torch.Tensor:
    """[N] the blending weight of each Gaussian, summed over the views; `pixels`: for how many one of a view stands."""
    total = gaussians.means.new_zeros(len(gaussians))
    for camera, share in zip(cameras, pixels, strict=True):
        ones = total.new_ones(camera.height, camera.width, 1)
        total += share * rasterizer.accumulate(gaussians, camera, ones)[:, 0]
    return total


@torch.no_grad()
def look(gaussians: Gaussians, cameras: Sequence[Camera]) -> Patches:
    """What one sees in these views."""
    drawings = ((camera, rasterizer.render(gaussians, camera)) for camera in cameras)
    seen = [_patches(c, d.color.double().cpu().numpy(), d.alpha.double().cpu().numpy()) for c, d in drawings]
    return joined(seen)


def brought(gaussians: Gaussians, cameras: Sequence[Camera]) -> Patches:
    """What unsupported Gaussians tell that no frame holds: points of the scene's own, coloured by other photographs.

    As Gaussians they are blobs, since nothing made a surface of them; their colours are true. Those within a frame lie
    behind or in something, and say nothing.
    """
    means = gaussians.means.double().cpu().numpy()
    outside = np.ones(len(means), bool)
    for camera in cameras:
        uv, _ = geometry.project(means, camera)
        outside &= ~((uv >= 0) & (uv < (camera.width, camera.height))).all(1)
    colors = 0.5 + SH0 * gaussians.sh[:, 0].double().cpu().numpy()[outside]
    middle, blur = np.mean([camera.center for camera in cameras], axis=0), np.full(len(colors), BROUGHT_BLUR)
    return Patches(np.broadcast_to(middle, colors.shape), means[outside] - middle, colors.clip(0, 1), blur)


def joined(patches: Sequence[Patches]) -> Patches:
    return Patches(*(np.concatenate(column) for column in zip(*patches, strict=True)))


def reduced(camera: Camera, longest: int) -> Camera:
    """The same view, no side longer than this many pixels."""
    share = min(1.0, longest / max(camera.width, camera.height))
    return camera.resized(max(1, round(camera.width * share)), max(1, round(camera.height * share)))


def _patches(camera: Camera, color: np.ndarray, alpha: np.ndarray) -> Patches:
    """A view's blocks of which at least a half is covered."""
    rows, columns = (np.arange(0, size, BLOCK) for size in color.shape[:2])
    total = lambda values: np.add.reduceat(np.add.reduceat(values, rows, 0), columns, 1)
    covered, size = total(alpha), total(np.ones_like(alpha))
    chosen = covered > 0.5 * size
    colors = total(color)[chosen] / covered[chosen][:, None]
    rays = (total(geometry.pixel_rays(camera)) / size[..., None])[chosen] @ camera.world_to_camera[:3, :3]
    blur = np.full(len(colors), SEEN_BLUR)
    return Patches(np.broadcast_to(camera.center, colors.shape), rays, colors.clip(0, 1), blur)


def backdrop(scenes: Sequence[Gaussians], cameras: Sequence[Camera], patches: Patches) -> Gaussians:
    """`DISKS` soft disks, float32 on the CPU, on a sphere that lies behind all the Gaussians and all the cameras.

    A disk's colour is the mean of the patches' colours, each where its ray meets the sphere, by nearness on it.
    """
    centers = np.stack([camera.center for camera in cameras])
    middle = centers.mean(0)
    means = [gaussians.means.double().cpu().numpy() for gaussians in scenes if len(gaussians)]
    radius = CLEAR * max(np.linalg.norm(points - middle, axis=1).max() for points in (*means, centers))
    towards = _spread_directions(DISKS)
    places = _met((patches.origins - middle) / radius, patches.directions)
    colors = _continued(towards, places, patches.colors, patches.blur)
    sh = np.zeros((DISKS, scenes[0].sh.shape[1], 3))
    sh[:, 0] = (colors - 0.5) / SH0
    sizes = radius * APART * np.array([0.8, 0.8, 0.05])
    # The shortest turn from z to the direction; straight backwards any half turn will do.
    turns = np.concatenate([1 + towards[:, 2:], np.cross([0.0, 0.0, 1.0], towards)], 1)
    logits = np.full(DISKS, math.log(0.98 / 0.02))
    arrays = (middle + radius * towards, turns, np.log(np.tile(sizes, (DISKS, 1))), logits, sh)
    return Gaussians(*(torch.from_numpy(array).float() for array in arrays), antialiased=scenes[0].antialiased)


def _spread_directions(count: int) -> np.ndarray:
    """[count, 3] unit vectors, about equally far apart: a spiral of the golden ratio."""
    index = np.arange(count) + 0.5
    height, turn = 1 - 2 * index / count, math.pi * (1 + math.sqrt(5)) * index
    level = np.sqrt(1 - height**2)
    return np.stack([level * np.cos(turn), level * np.sin(turn), height], 1)


def _met(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """[S, 3] unit vectors: where rays from within the unit sphere, [S, 3] both, leave it."""
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions / np.maximum(length, np.finfo(np.float64).tiny)  # of no length: stays where it is
    along = (origins * directions).sum(1)
    far = np.sqrt(along**2 + 1 - (origins**2).sum(1)) - along
    return origins + far[:, None] * directions


def _continued(towards: np.ndarray, places: np.ndarray, colors: np.ndarray, blur: np.ndarray) -> np.ndarray:
    """[D, 3] colours at unit vectors `towards`: the mean of those at `places` [S, 3], by distance to the power -6,
    and equal within `blur` [S]."""
    mixed = np.empty_like(towards)
    for part in np.array_split(np.arange(len(towards)), 10):  # all at once would take gigabytes
        square = 2 - 2 * towards[part] @ places.T
        weight = 1 / (square + blur**2) ** 3
        mixed[part] = weight @ colors / weight.sum(1, keepdims=True)
    return mixed
