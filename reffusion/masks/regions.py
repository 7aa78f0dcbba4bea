"""Regions in space to fill or to remove, and the masks that they have in the views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from reffusion import geometry, morphology
from reffusion.types import Camera, Gaussians

SHOWN = 0.1  # rendered label from which a pixel shows new Gaussians
CLOSED = 0.008  # of the image's width: notches up to twice as wide are closed


@dataclass(frozen=True)
class Region:
    """An axis-aligned box in the normalised frame, or the ellipsoid inscribed in it.

    Attributes:
        center, size: [3] each, middle and side lengths.
        round: it is the ellipsoid.
        holds: it holds the object, and the Gaussians in it are removed; else it is only filled.
    """

    center: Sequence[float] | np.ndarray
    size: Sequence[float] | np.ndarray
    round: bool = False
    holds: bool = True


@dataclass(frozen=True)
class FillRequest:
    """What is invented although photographs show something there.

    Attributes:
        region: of space, or None. masks: view name -> bool [H, W].
    """

    region: Region | None
    masks: dict[str, np.ndarray]

    def __bool__(self) -> bool:
        return self.region is not None or bool(self.masks)

    def render(self, camera: Camera, depth: np.ndarray) -> np.ndarray:
        """bool [H, W]: the pixels to fill in a view whose remaining surfaces, at `depth` [H, W], may occlude some."""
        mask = self.masks.get(camera.name, np.zeros(depth.shape, bool))
        if self.region is None:
            return mask
        return mask | silhouette(self.region, camera, geometry.reciprocal(depth))


def silhouette(region: Region, camera: Camera, disparity: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels whose ray meets the region in front of the surface of this disparity, [H, W]."""
    near, far = _ray_interval(region, camera)
    return (far > np.maximum(near, 0.0)) & (np.maximum(near, 0.0) * disparity < 1.0)


def outside_sphere(center: np.ndarray, radius: float, camera: Camera) -> np.ndarray:
    """bool [H, W]: pixels whose ray misses a sphere in front of the camera (the paper's inverse masks, section 5.4)."""
    return ~silhouette(Region(center, [2 * radius] * 3, True), camera, np.zeros((camera.height, camera.width)))


def point_on_axis(camera: Camera, distance: float) -> np.ndarray:
    """[3], the point at this distance along the optical axis."""
    return camera.center + distance * camera.world_to_camera[2, :3]


def inside_region(gaussians: Gaussians, region: Region) -> Tensor:
    """bool [N]: Gaussians whose centre lies in the region."""
    middle, sides = (gaussians.means.new_tensor(np.asarray(each)) for each in (region.center, region.size))
    delta = (gaussians.means - middle) / (sides / 2)
    return (delta**2).sum(-1) <= 1 if region.round else (delta.abs() <= 1).all(-1)


def restrict_to_new(invent: np.ndarray, consistent: np.ndarray, new_share: np.ndarray) -> np.ndarray:
    """bool [H, W]: I of a view once the references' pixels are in the scene.

    PAPER leaves open: where a region is filled over what remains, only what a reference drew is repainted;
    photographs know the rest of it.

    Args:
        invent, consistent: bool [H, W], I and C.
        new_share: [H, W] in [0, 1), the rendered labels of the new Gaussians.
    """
    closed = ~morphology.dilate(~morphology.dilate(new_share > SHOWN, CLOSED), CLOSED)
    return invent & (consistent | closed)


def _ray_interval(region: Region, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Camera z at which rays enter and leave the region, [H, W] each; not enter < leave, or NaN, where they miss it."""
    rays = geometry.pixel_rays(camera) @ camera.world_to_camera[:3, :3]
    half = np.asarray(region.size) / 2
    offset = np.asarray(region.center) - camera.center
    with np.errstate(divide="ignore", invalid="ignore"):
        if not region.round:
            bounds = (offset + np.multiply.outer((-1, 1), half))[:, None, None] / rays
            return np.fmin(*bounds).max(-1), np.fmax(*bounds).min(-1)
        # |(z ray - offset) / half|^2 = 1, a quadratic equation in z
        along, middle = rays / half, offset / half
        a, b, c = (along**2).sum(-1), along @ middle, middle @ middle - 1
        root = np.sqrt(b**2 - a * c)
        return (b - root) / a, (b + root) / a
