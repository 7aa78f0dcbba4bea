"""Regions of space to fill or to remove, which the scene names, and their masks in the views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from reffusion import geometry, morphology
from reffusion.io.files import BadInput
from reffusion.types import Camera, Gaussians, Scene

SHOWN = 0.1  # rendered label of new Gaussians above which a pixel shows them
CLOSED = 0.008  # of the image's width: gaps up to twice as wide are closed


@dataclass(frozen=True)
class Region:
    """An axis-aligned box in the normalized frame, or the ellipsoid inscribed in it.

    Attributes:
        center: [3], the middle.
        size: [3], the side lengths of the box.
        round: True if the region is the ellipsoid.
        holds: True if the region holds the object, so that the Gaussians inside are removed; False if the region is
            only filled.
    """

    center: Sequence[float] | np.ndarray
    size: Sequence[float] | np.ndarray
    round: bool = False
    holds: bool = True


@dataclass(frozen=True)
class FillRequest:
    """The pixels that the scene asks to fill: they are invented although photographs show something there.

    A request for no pixels is False as a bool.

    Attributes:
        region: region of space to fill; None if there is none.
        masks: view name -> bool [H, W], True at the pixels to fill in this view; other views have no entry.
    """

    region: Region | None
    masks: dict[str, np.ndarray]

    def __bool__(self) -> bool:
        return self.region is not None or bool(self.masks)

    def render(self, camera: Camera, depth: np.ndarray) -> np.ndarray:
        """Return bool [H, W], the pixels to fill in a view: those of its mask, and those that show the region.

        Args:
            camera: the view.
            depth: [H, W], camera z of the remaining surfaces, which may occlude the region; 0 where there are none.
        """
        mask = self.masks.get(camera.name, np.zeros(depth.shape, bool))
        if self.region is None:
            return mask
        return mask | silhouette(self.region, camera, geometry.reciprocal(depth))


def silhouette(region: Region, camera: Camera, disparity: np.ndarray) -> np.ndarray:
    """Return bool [H, W], the pixels whose rays meet the region before they meet the visible surface.

    Args:
        disparity: [H, W], 1 / camera z of the visible surface; 0 where there is no surface.
    """
    near, far = _ray_interval(region, camera)
    return (far > np.maximum(near, 0.0)) & (np.maximum(near, 0.0) * disparity < 1.0)


def outside_sphere(center: np.ndarray, radius: float, camera: Camera) -> np.ndarray:
    """Return bool [H, W], the pixels whose rays miss a sphere (the paper's inverse masks, section 5.4).

    A ray starts at the camera's center, so all rays miss a sphere behind the camera.

    Args:
        center: [3], in world coordinates.
        radius: in world units.
    """
    return ~silhouette(Region(center, [2 * radius] * 3, True), camera, np.zeros((camera.height, camera.width)))


def point_on_axis(camera: Camera, distance: float) -> np.ndarray:
    """Return [3], the world point on the camera's optical axis at this distance in front of the camera's center."""
    return camera.center + distance * camera.world_to_camera[2, :3]


def check_region(region: Region, scene: Scene) -> None:
    """Raise BadInput if the region lies in no training view; the message names places in the scene's own frame."""
    cameras = [scene.cameras[name] for name in scene.train]
    if any(silhouette(region, camera, np.zeros((camera.height, camera.width))).any() for camera in cameras):
        return
    middle = np.mean([camera.center for camera in cameras], 0)
    center, middle = (scene.similarity.invert(place) for place in (np.asarray(region.center), middle))
    write = lambda place: "[" + ", ".join(f"{number:.3g}" for number in place) + "]"
    raise BadInput(
        f"region: no view shows it; its center is {write(center)}, and the cameras are around {write(middle)}. "
        "Is it in the unit and frame of the poses?"
    )


def inside_region(gaussians: Gaussians, region: Region) -> Tensor:
    """Return bool [N], True for the Gaussians whose means lie in the region."""
    middle, sides = (gaussians.means.new_tensor(np.asarray(each)) for each in (region.center, region.size))
    delta = (gaussians.means - middle) / (sides / 2)
    return (delta**2).sum(-1) <= 1 if region.round else (delta.abs() <= 1).all(-1)


def restrict_to_new(invent: np.ndarray, consistent: np.ndarray, new_share: np.ndarray) -> np.ndarray:
    """Return the invent mask I of a view, restricted to C and to the pixels that show new Gaussians.

    This happens once the references are in the scene as new Gaussians. C are the pixels of the removed object. Outside
    C, a region that the scene asks to fill also covers pixels at which the references inserted nothing.

    PAPER leaves open: where a region is filled in front of remaining surfaces, only the pixels that a reference drew
    are repainted. Photographs show the other pixels of the region.

    Args:
        invent: bool [H, W], I.
        consistent: bool [H, W], C.
        new_share: [H, W] in [0, 1), the rendered labels of the new Gaussians.

    Returns:
        bool [H, W], the restricted I.
    """
    closed = ~morphology.dilate(~morphology.dilate(new_share > SHOWN, CLOSED), CLOSED)
    return invent & (consistent | closed)


def _ray_interval(region: Region, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the camera z at which the rays of a view enter and leave the region, [H, W] each; may be negative."""
    rays = geometry.pixel_rays(camera) @ camera.world_to_camera[:3, :3]
    half = np.asarray(region.size) / 2
    offset = np.asarray(region.center) - camera.center
    # Where a ray misses the region, the two values are NaN, or the first is not less than the second. Negative values
    # are behind the camera.
    with np.errstate(divide="ignore", invalid="ignore"):
        if not region.round:
            bounds = (offset + np.multiply.outer((-1, 1), half))[:, None, None] / rays
            return np.fmin(*bounds).max(-1), np.fmax(*bounds).min(-1)
        # |(z ray - offset) / half|^2 = 1, a quadratic equation in z
        along, middle = rays / half, offset / half
        a, b, c = (along**2).sum(-1), along @ middle, middle @ middle - 1
        root = np.sqrt(b**2 - a * c)
        return (b - root) / a, (b + root) / a
