"""Photographs along planes: which one a pixel lies on, where, and how far a step of a pixel goes on it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reffusion import geometry
from reffusion.background.plane import Plane
from reffusion.types import Camera

ON = 0.03  # relative depth within which a pixel lies on a plane


def labelled(depth: np.ndarray, camera: Camera, planes: Sequence[Plane]) -> np.ndarray:
    """int [H, W]: the plane that each pixel lies on, 1, 2, ...; 0: none."""
    surface, nearest = np.zeros(depth.shape, np.int64), np.full(depth.shape, ON)
    for k, plane in enumerate(planes, start=1):
        off = np.abs(depth / plane.depth(camera) - 1)
        mine = (off < nearest) & (depth > 0)
        surface[mine], nearest[mine] = k, off[mine]
    return surface


def frames_of(surface: np.ndarray, camera: Camera, planes: Sequence[Plane]) -> np.ndarray:
    """[H, W, 2, 2]: change of the coordinates along a pixel's plane with x and y in pixels; the identity off planes."""
    frames = np.broadcast_to(np.eye(2), (*surface.shape, 2, 2)).copy()
    rays = geometry.pixel_rays(camera) @ camera.world_to_camera[:3, :3]
    steps = camera.world_to_camera[:2, :3] / np.array([[camera.fx], [camera.fy]])
    for k, plane in enumerate(planes, start=1):
        mine = surface == k
        slope = rays[mine] @ plane.normal
        distance = (plane.offset - camera.center @ plane.normal) / slope
        for axis, step in enumerate(steps):
            moved = step - rays[mine] * (step @ plane.normal / slope)[:, None]
            frames[mine, :, axis] = distance[:, None] * moved @ plane.axes.T
    return frames


def places_of(surface: np.ndarray, camera: Camera, planes: Sequence[Plane]) -> np.ndarray:
    """[H, W, 2]: where on its plane each pixel lies, in the plane's own coordinates; 0 off planes."""
    places = np.zeros((*surface.shape, 2))
    rays = geometry.pixel_rays(camera) @ camera.world_to_camera[:3, :3]
    for k, plane in enumerate(planes, start=1):
        mine = surface == k
        distance = (plane.offset - camera.center @ plane.normal) / (rays[mine] @ plane.normal)
        places[mine] = (camera.center + rays[mine] * distance[:, None] - plane.origin) @ plane.axes.T
    return places


def inverse(matrices: np.ndarray) -> np.ndarray:
    """Of [..., 2, 2]; zeros for one that has none, as where a plane is seen edge on."""
    (a, b), (c, d) = (np.moveaxis(matrices[..., row, :], -1, 0) for row in (0, 1))
    with np.errstate(invalid="ignore"):
        area = a * d - b * c
    known = np.isfinite(area) & (area != 0)
    adjugate = np.stack([np.stack([d, -b], -1), np.stack([-c, a], -1)], -2)
    return np.divide(adjugate, area[..., None, None], out=np.zeros(matrices.shape), where=known[..., None, None])
