"""Cameras around a hole, for a scene that brings Gaussians and neither photographs nor cameras."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import islice

import numpy as np
from scipy.spatial import cKDTree

from reffusion.capture.layouts.capture import NO_POINTS, Poses
from reffusion.capture.lens import Lens
from reffusion.io.files import BadInput

ANGLE = np.radians(60)  # of view, across
ASPECT = 4 / 3
DIRECTIONS, MOST = 400, 40  # that are tried, all over the sphere, and views that are kept
BESIDE = 500  # splats next to the hole that tell which way is up
RAYS, GRID = 24, (8, 6)  # to the hole, by which it is found whether something stands before it; over the picture
CLOSE = 0.25  # of the hole's radius: what is that near to its splats is the ground they stand on
CLEAR = 0.25  # of the hole's radius: so near to a camera there is no splat, or it would stand in a surface
REACH = 2.0  # of a splat's standard deviation: so near to its middle a ray meets it
FAR = 20.0  # of the hole's radius: where rays end
MARCH = 80  # steps of a ray
AROUND, BESIDES = 16, 1.5  # rays past the hole, and how far from its middle they pass, in its radii
BEYOND = 0.35  # of these that must come farther than the hole: before a camera behind a wall, all of them end in it
NEAR, IN_FRONT = 0.5, 0.1  # of the way to the hole; share of the picture that may show what is nearer than that
LEAST = 3  # views


@dataclass(frozen=True)
class Demands:
    """What a place must offer to be a camera's.

    Attributes:
        distances: from the hole, in its radii; of each direction the first that will do is taken.
        free: share of the rays to the hole that must pass.
        filled: share of the rays over the picture that must meet something: where they do not, the scene was not
            photographed from there.
        height: cosine of the angle between the direction and up that it must exceed; 0 is level with the hole.
    """

    distances: tuple[float, ...]
    free: float
    filled: float
    height: float


# In turn, until three places will do: a table-top scene fills pictures from above only, a room with an open side or a
# hole in its corner hardly from anywhere, and one between other things shows itself in part.
DEMANDS = (
    Demands((4.0, 2.8, 2.0), 0.7, 0.9, 0.0),
    Demands((4.0, 2.8, 2.0), 0.7, 0.8, 0.0),
    Demands((6.0, 4.0, 2.8, 2.0, 1.5), 0.6, 0.65, 0.0),
    Demands((6.0, 4.0, 2.8, 2.0, 1.5), 0.4, 0.5, -0.3),
)


@dataclass(frozen=True)
class Sight:
    """What is seen from a place: the shares that `Demands` asks for; none of either where no camera can stand."""

    free: float
    filled: float


def cameras_around(means: np.ndarray, sizes: np.ndarray, opaque: np.ndarray, deleted: np.ndarray, width: int) -> Poses:
    """Views of the hole from all sides from which what stays does not hide it, and the scene fills the picture: so it
    was photographed from there, or can be looked at from there. Where fewer than three are found, `DEMANDS` demands
    less; no camera stands in a surface.

    Args:
        means: [N, 3], the whole scene's, in its own frame; sizes: [N], of each the middle one of its three standard
            deviations: needles are what nobody photographed.
        opaque: bool [N]; deleted: bool [N], the hole.
        width: of the views, in pixels.

    Raises:
        BadInput: there are fewer than three such places.
    """
    hole, keep = means[deleted], opaque & ~deleted
    if np.count_nonzero(keep) < BESIDE:
        raise BadInput(f"scene.yaml: cleaned: {keep.sum()} opaque splats are left: too few to say where cameras can be")
    center = np.median(hole, 0)
    radius = float(np.percentile(np.linalg.norm(hole - center, axis=1), 95))
    stays = cKDTree(means[keep]), REACH * sizes[keep]
    up, aim = _up(hole, means[keep], center), hole[:: max(1, len(hole) // RAYS)][:RAYS]
    height, focal = round(width / ASPECT), width / 2 / np.tan(ANGLE / 2)
    lens = Lens(width, height, focal, focal, width / 2, height / 2)
    directions = _directions(DIRECTIONS)
    pose = lambda direction, away: _looking(center + away * radius * directions[direction], center, up)

    @cache
    def sight(direction: int, away: float) -> Sight:
        return _sight(pose(direction, away), away * radius, lens, aim, stays, radius)

    for demands in DEMANDS:
        found = []
        for direction in np.flatnonzero(directions @ up > demands.height):
            seen = ((away, sight(direction, away)) for away in demands.distances)
            fits = (away for away, s in seen if s.free >= demands.free and s.filled >= demands.filled)
            found += [pose(direction, away) for away in islice(fits, 1)]
        if len(found) >= LEAST:
            break
    else:
        raise BadInput(
            "scene.yaml: cleaned: from hardly anywhere around it the hole is in sight and the scene whole; bring "
            "cameras, as transforms.json or a COLMAP model"
        )
    found = found[:: -(-len(found) // MOST)]
    named = {f"around_{index:02d}": pose for index, pose in enumerate(found)}
    return Poses(dict.fromkeys(named, lens), named, *NO_POINTS, {})


def _directions(count: int) -> np.ndarray:
    """[count, 3], unit vectors spread evenly, neighbours far apart in number."""
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - height**2)
    return np.stack([level * np.cos(turn), level * np.sin(turn), height], 1)


def _up(hole: np.ndarray, stays: np.ndarray, center: np.ndarray) -> np.ndarray:
    """[3], the normal of what stays next to the hole, to the side on which the hole is."""
    beside = stays[np.argsort(cKDTree(hole).query(stays)[0])[:BESIDE]]
    middle = np.median(beside, 0)
    normal = np.linalg.svd(beside - middle, full_matrices=False)[2][2]
    return normal if normal @ (center - middle) >= 0 else -normal


def _sight(
    pose: np.ndarray, away: float, lens: Lens, aim: np.ndarray, stays: tuple[cKDTree, np.ndarray], radius: float
) -> Sight:
    """What a camera, `away` from the middle of the hole, sees of the hole, its splats `aim` [P, 3], and of the scene;
    nothing where it stands in a splat, right before one, or behind the surface on which the hole is."""
    place = -pose[:3, :3].T @ pose[:3, 3]
    distance, nearest = stays[0].query(place)
    if distance < max(CLEAR * radius, stays[1][nearest]):
        return Sight(0.0, 0.0)
    turns = 2 * np.pi * np.arange(AROUND) / AROUND
    past = np.array([0, 0, 1.0]) * away + BESIDES * radius * np.stack([np.cos(turns), np.sin(turns), 0 * turns], 1)
    ends = np.linalg.norm(past, axis=1) * (1 - CLOSE * radius / away)
    if np.mean(~_met(place, past @ pose[:3, :3], ends, stays)) < BEYOND:
        return Sight(0.0, 0.0)
    ways = aim - place
    lengths = np.linalg.norm(ways, axis=1)
    free = float(np.mean(~_met(place, ways, np.maximum(lengths - CLOSE * radius, 0), stays)))
    if free < min(demands.free for demands in DEMANDS):
        return Sight(free, 0.0)
    columns, rows = ((np.arange(n) + 0.5) / n for n in GRID)
    x, y = np.meshgrid((columns * lens.width - lens.cx) / lens.fx, (rows * lens.height - lens.cy) / lens.fy)
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ pose[:3, :3]
    if np.mean(_met(place, rays, np.full(len(rays), NEAR * away), stays)) > IN_FRONT:
        return Sight(0.0, 0.0)
    return Sight(free, float(np.mean(_met(place, rays, np.full(len(rays), FAR * radius), stays))))


def _met(place: np.ndarray, ways: np.ndarray, ends: np.ndarray, stays: tuple[cKDTree, np.ndarray]) -> np.ndarray:
    """bool [R]: the rays [R, 3] that meet a splat before their ends [R]. Each goes on by about the distance to the
    nearest splat, so that it passes none."""
    tree, near = stays
    ways = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    met, gone, on = np.zeros(len(ways), bool), np.zeros(len(ways)), np.arange(len(ways))
    for _ in range(MARCH):
        distance, nearest = tree.query(place + gone[on, None] * ways[on])
        met[on] = distance <= near[nearest]
        gone[on] += np.maximum(distance - near[nearest], near[nearest])
        on = on[~met[on] & (gone[on] < ends[on])]
        if not len(on):
            break
    return met


def _looking(place: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """[4, 4] world to camera."""
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 0.05:  # straight from above: any side will do
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ place
    return pose
