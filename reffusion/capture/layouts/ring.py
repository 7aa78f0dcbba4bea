"""Places cameras around a hole, for a scene that brings Gaussians and neither photographs nor cameras."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import islice

import numpy as np
from scipy.spatial import cKDTree

from reffusion.capture.layouts.capture import NO_POINTS, Poses
from reffusion.capture.lens import Lens
from reffusion.io.files import BadInput

ANGLE = np.radians(60)  # horizontal field of view
ASPECT = 4 / 3
DIRECTIONS, MOST = 400, 40  # directions that are tried, all over the sphere, and views that are kept at most
BESIDE = 500  # splats next to the hole, which tell the direction up
RAYS, GRID = 24, (8, 6)  # rays to the hole, which tell if something hides it; and the grid of rays over the picture
CLOSE = 0.25  # of the hole's radius: what is that near to its splats is the ground they stand on
CLEAR = 0.25  # of the hole's radius: smallest distance of a camera from a splat, so that it stands in no surface
REACH = 2.0  # standard deviations of a splat within which a ray hits it
FAR = 20.0  # of the hole's radius: where rays end
MARCH = 80  # steps of a ray
AROUND, BESIDES = 16, 1.5  # number of rays past the hole, and their distance from its middle, in its radii
BEYOND = 0.35  # share of these that must get further than the hole; if the camera is behind a wall, all end in it
NEAR, IN_FRONT = 0.5, 0.1  # share of the distance to the hole; share of the picture that may show nearer things
LEAST = 3  # views


@dataclass(frozen=True)
class ViewRequirements:
    """What a camera position must offer.

    Attributes:
        distances: from the hole, in its radii; of each direction the first suitable one is taken.
        free: share of the rays to the hole that must reach it.
        filled: share of the rays over the picture that must hit something; where fewer do, nobody photographed from
            there.
        height: cosine of the angle between the direction and up, at least; 0 is level with the hole.
    """

    distances: tuple[float, ...]
    free: float
    filled: float
    height: float


# Tried in turn, until three positions are found: a table-top scene fills pictures from above only, a room with an open
# side or a hole in its corner from hardly anywhere, and a hole between other things is visible in part.
REQUIREMENTS = (
    ViewRequirements((4.0, 2.8, 2.0), 0.7, 0.9, 0.0),
    ViewRequirements((4.0, 2.8, 2.0), 0.7, 0.8, 0.0),
    ViewRequirements((6.0, 4.0, 2.8, 2.0, 1.5), 0.6, 0.65, 0.0),
    ViewRequirements((6.0, 4.0, 2.8, 2.0, 1.5), 0.4, 0.5, -0.3),
)


@dataclass(frozen=True)
class ViewQuality:
    """What is visible from a position, as shares for `ViewRequirements`; both 0 where no camera can stand."""

    free: float
    filled: float


def place_cameras(means: np.ndarray, sizes: np.ndarray, opaque: np.ndarray, deleted: np.ndarray, width: int) -> Poses:
    """Cameras around the hole, where nothing hides it and the scene fills the picture.

    Such places are where the scene was photographed from, or can be looked at from. Where fewer than three are found,
    `REQUIREMENTS` are relaxed. No camera stands in a surface.

    Args:
        means: [N, 3] of the whole scene, in its own frame; sizes: [N], the middle of each splat's three standard
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
    up, aim = _estimate_up(hole, means[keep], center), hole[:: max(1, len(hole) // RAYS)][:RAYS]
    height, focal = round(width / ASPECT), width / 2 / np.tan(ANGLE / 2)
    lens = Lens(width, height, focal, focal, width / 2, height / 2)
    directions = _directions(DIRECTIONS)
    pose = lambda direction, away: _look_at(center + away * radius * directions[direction], center, up)

    @cache
    def sight(direction: int, away: float) -> ViewQuality:
        return _rate_view(pose(direction, away), away * radius, lens, aim, stays, radius)

    for demands in REQUIREMENTS:
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
    """[count, 3], unit vectors spread evenly on the sphere; consecutive ones are far apart."""
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - height**2)
    return np.stack([level * np.cos(turn), level * np.sin(turn), height], 1)


def _estimate_up(hole: np.ndarray, stays: np.ndarray, center: np.ndarray) -> np.ndarray:
    """[3], the normal of the surface next to the hole, towards the hole."""
    beside = stays[np.argsort(cKDTree(hole).query(stays)[0])[:BESIDE]]
    middle = np.median(beside, 0)
    normal = np.linalg.svd(beside - middle, full_matrices=False)[2][2]
    return normal if normal @ (center - middle) >= 0 else -normal


def _rate_view(
    pose: np.ndarray, away: float, lens: Lens, aim: np.ndarray, stays: tuple[cKDTree, np.ndarray], radius: float
) -> ViewQuality:
    """What a camera, `away` from the middle of the hole, sees of the hole (its splats `aim` [P, 3]) and of the scene.

    Nothing where it stands in a splat, right in front of one, or behind the surface that the hole is on.
    """
    place = -pose[:3, :3].T @ pose[:3, 3]
    distance, nearest = stays[0].query(place)
    if distance < max(CLEAR * radius, stays[1][nearest]):
        return ViewQuality(0.0, 0.0)
    turns = 2 * np.pi * np.arange(AROUND) / AROUND
    past = np.array([0, 0, 1.0]) * away + BESIDES * radius * np.stack([np.cos(turns), np.sin(turns), 0 * turns], 1)
    ends = np.linalg.norm(past, axis=1) * (1 - CLOSE * radius / away)
    if np.mean(~_hits(place, past @ pose[:3, :3], ends, stays)) < BEYOND:
        return ViewQuality(0.0, 0.0)
    rays = aim - place
    lengths = np.linalg.norm(rays, axis=1)
    free = float(np.mean(~_hits(place, rays, np.maximum(lengths - CLOSE * radius, 0), stays)))
    if free < min(demands.free for demands in REQUIREMENTS):
        return ViewQuality(free, 0.0)
    columns, rows = ((np.arange(n) + 0.5) / n for n in GRID)
    x, y = np.meshgrid((columns * lens.width - lens.cx) / lens.fx, (rows * lens.height - lens.cy) / lens.fy)
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ pose[:3, :3]
    if np.mean(_hits(place, rays, np.full(len(rays), NEAR * away), stays)) > IN_FRONT:
        return ViewQuality(0.0, 0.0)
    return ViewQuality(free, float(np.mean(_hits(place, rays, np.full(len(rays), FAR * radius), stays))))


def _hits(place: np.ndarray, rays: np.ndarray, ends: np.ndarray, stays: tuple[cKDTree, np.ndarray]) -> np.ndarray:
    """bool [R]: the rays [R, 3] that hit a splat before their ends [R]. Each advances by about the distance to the
    nearest splat, so that it misses none (sphere tracing)."""
    tree, near = stays
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    hit, traveled, on = np.zeros(len(rays), bool), np.zeros(len(rays)), np.arange(len(rays))
    for _ in range(MARCH):
        distance, nearest = tree.query(place + traveled[on, None] * rays[on])
        hit[on] = distance <= near[nearest]
        traveled[on] += np.maximum(distance - near[nearest], near[nearest])
        on = on[~hit[on] & (traveled[on] < ends[on])]
        if not len(on):
            break
    return hit


def _look_at(place: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
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
