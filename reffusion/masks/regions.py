"""From a place in space to masks: a region that is to be filled, and all that lies beyond a sphere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from reffusion import geometry
from reffusion.background.visibility import widened
from reffusion.types import Camera, Gaussians

SHOWN = 0.1  # blending weight of new Gaussians from which a pixel shows them
CLOSED = 0.008  # of the image's width: notches up to twice as wide are closed


@dataclass(frozen=True)
class Region:
    """A box along the axes of the normalised frame, or the ball in it.

    Attributes:
        center, size: [3] each, middle and side lengths.
        round: the ball (all sides are its diameter).
        holds: it holds the object, and what is in it is removed; else it is only filled.
    """

    center: Sequence[float]
    size: Sequence[float]
    round: bool = False
    holds: bool = True


@dataclass(frozen=True)
class Filled:
    """What is made up whatever anyone saw: a region, and masks of it (view -> bool [H, W])."""

    region: Region | None
    masks: dict[str, np.ndarray]

    def __bool__(self) -> bool:
        return self.region is not None or bool(self.masks)

    def shown(self, camera: Camera, depth: np.ndarray) -> np.ndarray:
        """bool [H, W], in a view in which `depth` [H, W] of what stays hides some of it."""
        found = self.masks.get(camera.name, np.zeros(depth.shape, bool))
        if self.region is None:
            return found
        return found | silhouette(self.region, camera, geometry.reciprocal(depth))


def silhouette(region: Region, camera: Camera, disparity: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels whose ray meets the region before the surface of the given disparity [H, W]."""
    near, far = _crossing(region, camera)
    return (far > np.maximum(near, 0.0)) & (np.maximum(near, 0.0) * disparity < 1.0)


def beyond(center: np.ndarray, radius: float, camera: Camera) -> np.ndarray:
    """bool [H, W]: pixels whose ray misses a sphere in front of the camera (the paper's inverse masks, section 5.4)."""
    return ~silhouette(Region(center, [2 * radius] * 3, True), camera, np.zeros((camera.height, camera.width)))


def on_axis(camera: Camera, distance: float) -> np.ndarray:
    """[3], the point at that distance along the optical axis."""
    return camera.center + distance * camera.world_to_camera[2, :3]


def inside(gaussians: Gaussians, region: Region) -> Tensor:
    """bool [N]: centres within the region."""
    middle, sides = (gaussians.means.new_tensor(np.asarray(each)) for each in (region.center, region.size))
    off = (gaussians.means - middle) / (sides / 2)
    return (off**2).sum(-1) <= 1 if region.round else (off.abs() <= 1).all(-1)


def where_drawn(invent: np.ndarray, consistent: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """bool [H, W]: I of a view, once the references' pixels stand in the scene. PAPER leaves open: where a region was
    to be filled over what stays, only what was drawn is repainted; photographs know the rest of it.

    Args:
        invent, consistent: bool [H, W], I and C.
        shown: [H, W] in [0, 1), what the view shows of the references' pixels.
    """
    return invent & (consistent | ~widened(~widened(shown > SHOWN, CLOSED), CLOSED))


def _crossing(region: Region, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Where rays enter and leave the region, [H, W] camera z each; enter > leave, or NaN, where they miss it."""
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
