"""Places cameras around a hole, for a scene that has only Gaussians, and neither photographs nor cameras.

The hole is where the user deleted Gaussians (also called splats). Its middle is the median of their means; its radius
is the distance from the middle within which 95% of the means lie. Rays test what a camera sees: a ray hits a remaining
opaque splat if it comes within `REACH` standard deviations of the splat's mean.
"""

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
DIRECTIONS, MOST = 400, 40  # number of directions that are tried, all over the sphere; largest number of cameras
BESIDE = 500  # number of splats next to the hole from which the direction up is estimated
RAYS, GRID = 24, (8, 6)  # number of rays to the hole; (columns, rows) of the grid of rays over the picture
CLOSE = 0.25  # hole radii: rays end this far before the hole, so that the ground under it hides nothing
CLEAR = 0.25  # hole radii: smallest distance of a camera from a splat, so that no camera is inside a surface
REACH = 2.0  # standard deviations of a splat within which a ray hits it
FAR = 20.0  # hole radii: length of the rays over the picture
MARCH = 80  # largest number of steps of a ray
AROUND, BESIDES = 16, 1.5  # number of rays that pass the hole, and their distance from its middle in hole radii
BEYOND = 0.35  # share of these rays that must get as far as the hole; behind a wall, none does
NEAR, IN_FRONT = 0.5, 0.1  # at most this share of the picture shows splats within NEAR times the hole's distance
LEAST = 3  # smallest number of cameras


@dataclass(frozen=True)
class ViewRequirements:
    """The requirements for a camera position.

    Attributes:
        distances: distances from the middle of the hole to try, in hole radii. Of each direction, the first suitable
            distance is taken.
        free: smallest share of the rays to the hole that reach the hole.
        filled: smallest share of the rays over the picture that hit a splat. From places with a smaller share, nobody
            photographed the scene.
        height: the cosine of the angle between up and the direction from the hole to the camera must be above this
            value; 0 is level with the hole.
    """

    distances: tuple[float, ...]
    free: float
    filled: float
    height: float


# These are tried in turn, from strict to loose, until three positions are found. A table-top scene fills pictures from
# above only. A room with an open side, or with the hole in a corner, fills pictures from hardly anywhere. A hole
# between other things is visible only in part.
REQUIREMENTS = (
    ViewRequirements((4.0, 2.8, 2.0), 0.7, 0.9, 0.0),
    ViewRequirements((4.0, 2.8, 2.0), 0.7, 0.8, 0.0),
    ViewRequirements((6.0, 4.0, 2.8, 2.0, 1.5), 0.6, 0.65, 0.0),
    ViewRequirements((6.0, 4.0, 2.8, 2.0, 1.5), 0.4, 0.5, -0.3),
)


@dataclass(frozen=True)
class ViewQuality:
    """The shares `free` and `filled` (`ViewRequirements`) of a position; both are 0 if no camera can be there."""

    free: float
    filled: float


def place_cameras(means: np.ndarray, sizes: np.ndarray, opaque: np.ndarray, deleted: np.ndarray, width: int) -> Poses:
    """Place cameras around the hole, at positions where nothing hides the hole and the scene fills the picture.

    From such positions the scene was probably photographed, or can at least be looked at. If fewer than three positions
    are found, looser `REQUIREMENTS` are tried. No camera is inside a surface. All look at the middle of the hole.

    Args:
        means: [N, 3], means of all splats of the scene before deletion, in the scene's own frame.
        sizes: [N], the median of each splat's three standard deviations. The median does not count the length of a
            needle (a long, thin splat), because no photograph shows needles.
        opaque: bool [N], True for opaque splats.
        deleted: bool [N], True for the splats that were deleted, at least one.
        width: width of the views in pixels; their height is 3/4 of it.

    Returns:
        3 to `MOST` cameras in the frame of `means`, without points, called around_00, around_01 and so on.

    Raises:
        BadInput: fewer than three positions are found, or fewer than `BESIDE` opaque splats remain.
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
    """Return `count` unit vectors, [count, 3], spread evenly over the sphere; consecutive vectors are far apart."""
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - height**2)
    return np.stack([level * np.cos(turn), level * np.sin(turn), height], 1)


def _estimate_up(hole: np.ndarray, stays: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Return the up direction [3]: the unit normal of the opaque splats' surface near the hole, on the hole's side."""
    beside = stays[np.argsort(cKDTree(hole).query(stays)[0])[:BESIDE]]
    middle = np.median(beside, 0)
    normal = np.linalg.svd(beside - middle, full_matrices=False)[2][2]
    return normal if normal @ (center - middle) >= 0 else -normal


def _rate_view(
    pose: np.ndarray, away: float, lens: Lens, aim: np.ndarray, stays: tuple[cKDTree, np.ndarray], radius: float
) -> ViewQuality:
    """Return the `ViewQuality` of a camera that looks at the middle of the hole from the distance `away`."""
    place = -pose[:3, :3].T @ pose[:3, 3]
    # `stays`: a tree of the remaining opaque splats' means, and the radii within which rays hit them. `aim`: points in
    # the hole, whose middle is `away` from the camera. Both shares are 0 if the camera is in a splat or right in front
    # of one.
    distance, nearest = stays[0].query(place)
    if distance < max(CLEAR * radius, stays[1][nearest]):
        return ViewQuality(0.0, 0.0)
    turns = 2 * np.pi * np.arange(AROUND) / AROUND
    past = np.array([0, 0, 1.0]) * away + BESIDES * radius * np.stack([np.cos(turns), np.sin(turns), 0 * turns], 1)
    # 0 if the camera is behind the surface on which the hole is
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
    # 0 if splats much nearer than the hole cover too much of the picture
    if np.mean(_hits(place, rays, np.full(len(rays), NEAR * away), stays)) > IN_FRONT:
        return ViewQuality(0.0, 0.0)
    return ViewQuality(free, float(np.mean(_hits(place, rays, np.full(len(rays), FAR * radius), stays))))


def _hits(place: np.ndarray, rays: np.ndarray, ends: np.ndarray, stays: tuple[cKDTree, np.ndarray]) -> np.ndarray:
    """Return bool [R], which rays from `place` hit a splat before `ends`; `stays`: tree of the splats' means, radii."""
    tree, near = stays
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    hit, traveled, on = np.zeros(len(rays), bool), np.zeros(len(rays)), np.arange(len(rays))
    # Sphere tracing: a ray advances by about the distance to the nearest splat, so that it misses none.
    for _ in range(MARCH):
        distance, nearest = tree.query(place + traveled[on, None] * rays[on])
        hit[on] = distance <= near[nearest]
        traveled[on] += np.maximum(distance - near[nearest], near[nearest])
        on = on[~hit[on] & (traveled[on] < ends[on])]
        if not len(on):
            break
    return hit


def _look_at(place: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the world-to-camera pose [4, 4] of a camera at `place` that looks at `target`, with `up` upwards."""
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 0.05:  # straight from above or below: any side may be up
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ place
    return pose
