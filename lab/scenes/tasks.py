"""Regions, depth and references for scenes that insert an object or continue the space beyond a sphere.

A camera is one row [16] of the ray caster, see `raycast`.
"""

from __future__ import annotations

import numpy as np

from lab.scenes import raycast
from lab.scenes.kinds import Kind
from lab.scenes.reconstruction import Frame
from lab.scenes.solids import Solids
from lab.scenes.world import World

ROOM_FOR_IT = 1.08  # radius of the region over the radius of the object inside
# Coverage is measured on every 61st pixel; a point is visible if its depth differs by less than 3 % from the view's.
GRID, NEAR = 61, 0.03
COVERED = 0.995  # share of the points beyond the sphere, visible in any view, that the references must show
SPHERE = 0.95  # metres: radius of the sphere beyond which the scene is to be continued


def without_object(solids: Solids) -> Solids:
    """Return the solids without the removable ones."""
    return solids._replace(**{name: each[~solids.removable] for name, each in solids._asdict().items()})


def bounding_region(solids: Solids) -> tuple[np.ndarray, float]:
    """Return a sphere around the removable solids, with a margin, as (center [3], radius), metres in the room frame."""
    center, reach = solids.center[solids.removable], solids.reach[solids.removable]
    half = solids.half[solids.removable]
    middle = ((center - half).min(0) + (center + half).max(0)) / 2
    return middle, ROOM_FOR_IT * float((np.linalg.norm(center - middle, axis=1) + reach).max())


def rays(camera: np.ndarray, kind: Kind, world: World) -> tuple[np.ndarray, np.ndarray]:
    """Return the first surface points [H, W, 3] and the unit directions [H, W, 3] of all pixels' rays.

    The object is included.
    """
    rows, columns = np.mgrid[: kind.height, : kind.width]
    centers = np.stack([columns, rows], -1).reshape(-1, 2) + 0.5
    points, _ = raycast.surface_points(world.solids, camera, centers, True)
    offsets = (points - camera[13:]).reshape(kind.height, kind.width, 3)
    return points.reshape(offsets.shape), offsets / np.linalg.norm(offsets, axis=-1, keepdims=True)


def depth(camera: np.ndarray, kind: Kind, world: World, frame: Frame) -> np.ndarray:
    """Return the true depth map of a view with the object, [H, W] camera z in the scene frame's unit."""
    points, _ = rays(camera, kind, world)
    return (frame.scale * ((points - camera[13:]) @ camera[4:13].reshape(3, 3)[:, 2])).astype(np.float32)


def estimate_disparity(depth: np.ndarray, hole: np.ndarray, error: float, draw: np.random.Generator) -> np.ndarray:
    """Return the disparity [H, W] of a depth map as a monocular network gives it: with smooth errors and another unit.

    The logarithm of the disparity is wrong by `error` in the middle of the hole, where the network sees painted
    content. The error falls towards the hole's border, where it is a third. Everywhere waves with an rms of a tenth of
    `error` are added. Sign, waves, scale and offset are random.

    Args:
        depth: [H, W], camera z.
        hole: bool [H, W], the pixels that the reference fills.
        error: largest error of the logarithm.
        draw: random generator.
    """
    rows, columns = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    down, across = np.nonzero(hole)
    (top, left), (bottom, right) = (down.min(), across.min()), (down.max() + 1, across.max() + 1)
    beside = (2 * columns - left - right) / (right - left), (2 * rows - top - bottom) / (bottom - top)
    field = draw.choice([-1, 1]) * np.exp(-np.square(beside).sum(0))
    for length in np.geomspace(0.3, 1, 4) * depth.shape[1]:
        turn, phase = draw.uniform(0, 2 * np.pi, 2)
        along = np.cos(turn) * columns + np.sin(turn) * rows
        field += 0.1 * np.sqrt(2 / 4) * np.sin(2 * np.pi * along / length + phase)
    scale, offset = draw.uniform(0.5, 2), draw.uniform(0, 0.5)
    return ((np.exp(error * field) / depth + offset / depth.mean()) * scale).astype(np.float32)


def outside_sphere(camera: np.ndarray, kind: Kind, world: World, center: np.ndarray, radius: float) -> np.ndarray:
    """Return bool [H, W], True for the pixels whose rays miss the sphere around `center` [3]."""
    _, along = rays(camera, kind, world)
    offset = center - camera[13:]
    return offset @ offset - (along @ offset) ** 2 > radius**2


def choose_covering_views(cameras: np.ndarray, kind: Kind, world: World, center: np.ndarray, first: int) -> list[int]:
    """Choose cameras greedily until they show `COVERED` of the points beyond the sphere that any camera shows.

    The points are samples of the surfaces at the pixels whose rays miss the sphere, see `outside_sphere`.

    Args:
        cameras: [V, 16].
        center: [3], center of the sphere with the radius `SPHERE`.
        first: index of the camera to begin with.

    Returns:
        Indices of the chosen cameras, `first` first.
    """
    depths, pooled = [], []
    for camera in cameras:
        points, _ = rays(camera, kind, world)
        depths.append((points - camera[13:]) @ camera[4:13].reshape(3, 3)[:, 2])
        pooled.append(points[outside_sphere(camera, kind, world, center, SPHERE)][::GRID])
    points = np.concatenate(pooled)
    visible = np.stack([_is_visible(points, *each, kind) for each in zip(cameras, depths, strict=True)])
    chosen = [first]
    while visible[chosen].any(0).mean() < COVERED * visible.any(0).mean():
        chosen.append(int((visible & ~visible[chosen].any(0)).sum(1).argmax()))
    return chosen


def _is_visible(points: np.ndarray, camera: np.ndarray, depth: np.ndarray, kind: Kind) -> np.ndarray:
    """Return bool [N], room points that a camera shows, lens distortion ignored; `depth` [H, W] is camera z, metres."""
    at = (points - camera[13:]) @ camera[4:13].reshape(3, 3)
    z = np.maximum(at[:, 2], 1e-6)
    column, row = (np.floor(camera[0] * at[:, k] / z + camera[1 + k]).astype(int) for k in (0, 1))
    framed = (at[:, 2] > 0) & (column >= 0) & (column < kind.width) & (row >= 0) & (row < kind.height)
    visible = np.zeros(len(points), bool)
    visible[framed] = np.abs(at[framed, 2] - depth[row[framed], column[framed]]) < NEAR * at[framed, 2]
    return visible


def point_on_axis(camera: np.ndarray, distance: float) -> np.ndarray:
    """Return the room point [3] on a camera's optical axis at a distance in metres."""
    return camera[13:] + distance * camera[4:13].reshape(3, 3)[:, 2]
