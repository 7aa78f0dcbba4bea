"""The planes that an image shows: for each pixel its plane, its coordinates on this plane, and their derivative."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reffusion import geometry
from reffusion.background.plane import Plane
from reffusion.types import Camera


def label_planes(depth: np.ndarray, camera: Camera, planes: Sequence[Plane]) -> np.ndarray:
    """Return int [H, W], the index of the plane on which each pixel lies.

    A pixel lies on a plane if its depth is within `geometry.OTHER_SURFACE` (relative) of the plane's depth in this
    view. The whole infinite plane counts, also where its map says that it does not exist.

    Args:
        depth: [H, W], camera z of the visible surface; 0 where unknown.
        camera: the view.
        planes: the planes, counted from 1 in the result.

    Returns:
        1, 2, ... for the first, second, ... plane; 0 for pixels on none of them. A pixel near several planes gets the
        one closest in depth.
    """
    label, nearest = np.zeros(depth.shape, np.int64), np.full(depth.shape, geometry.OTHER_SURFACE)
    for k, plane in enumerate(planes, start=1):
        off = np.abs(depth / plane.depth(camera) - 1)
        mine = (off < nearest) & (depth > 0)
        label[mine], nearest[mine] = k, off[mine]
    return label


def plane_jacobians(label: np.ndarray, camera: Camera, planes: Sequence[Plane]) -> np.ndarray:
    """Return [H, W, 2, 2], the derivative of a pixel's coordinates on its plane with respect to the pixel (x, y).

    The derivative is the identity for pixels on no plane.

    Args:
        label: int [H, W], the plane of each pixel, see `label_planes`.
        camera: the view.
        planes: the planes.
    """
    jacobians = np.broadcast_to(np.eye(2), (*label.shape, 2, 2)).copy()
    rays = geometry.pixel_rays(camera) @ camera.world_to_camera[:3, :3]
    steps = camera.world_to_camera[:2, :3] / np.array([[camera.fx], [camera.fy]])
    for k, plane in enumerate(planes, start=1):
        mine = label == k
        slope = rays[mine] @ plane.normal
        distance = (plane.offset - camera.center @ plane.normal) / slope
        for axis, step in enumerate(steps):
            moved = step - rays[mine] * (step @ plane.normal / slope)[:, None]
            jacobians[mine, :, axis] = distance[:, None] * moved @ plane.axes.T
    return jacobians


def plane_coordinates(label: np.ndarray, camera: Camera, planes: Sequence[Plane]) -> np.ndarray:
    """Return [H, W, 2], the coordinates of each pixel on its plane, along `Plane.axes` from `Plane.origin`.

    The coordinates are in world units, and 0 for pixels on no plane.

    Args:
        label: int [H, W], the plane of each pixel, see `label_planes`.
        camera: the view.
        planes: the planes.
    """
    coordinates = np.zeros((*label.shape, 2))
    rays = geometry.pixel_rays(camera) @ camera.world_to_camera[:3, :3]
    for k, plane in enumerate(planes, start=1):
        mine = label == k
        distance = (plane.offset - camera.center @ plane.normal) / (rays[mine] @ plane.normal)
        coordinates[mine] = (camera.center + rays[mine] * distance[:, None] - plane.origin) @ plane.axes.T
    return coordinates


def invert_2x2(matrices: np.ndarray) -> np.ndarray:
    """Return the inverses of matrices [..., 2, 2]; zeros for a singular one, as of a plane seen edge on."""
    (a, b), (c, d) = (np.moveaxis(matrices[..., row, :], -1, 0) for row in (0, 1))
    with np.errstate(invalid="ignore"):
        determinant = a * d - b * c
    regular = np.isfinite(determinant) & (determinant != 0)
    adjugate = np.stack([np.stack([d, -b], -1), np.stack([-c, a], -1)], -2)
    inverse = np.zeros(matrices.shape)
    return np.divide(adjugate, determinant[..., None, None], out=inverse, where=regular[..., None, None])
