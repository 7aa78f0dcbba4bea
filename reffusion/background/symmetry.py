"""Things that stand beside the object and are their own mirror images: what nobody saw of them is like what is seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from reffusion import geometry
from reffusion.background.mirrors import Mirror, reflected
from reffusion.background.plane import Plane, without_pits
from reffusion.background.visibility import Witness, seen_by, votes
from reffusion.splat.conventions import SH0
from reffusion.splat.reference import colors
from reffusion.types import Gaussians

REACH = 3.0  # radii of the object around its middle within which a thing must end
TOP = 1.25  # radii of it above its middle up to which things are looked at: what stands in a vase is none of it
CELL = 0.05  # of the object's radius: side of the cells that a thing is made of
ABOVE = 2.5  # cells above the ground, and off planes along it, from which something stands there
VIEWS = 12  # views that things are looked for in, every second of their rows and columns
ALONG = 0.9  # cosine of the angle to the ground under which a plane lies along it
SEEN_SO_OFTEN = 3  # points of a cell that is something's
FEWEST = 200  # cells of a thing
OVER = 0.02  # share of its cells at the border of what is looked at, from which it may go on there
ASKED = 400  # of its cells that tell of a mirror
ANGLES, PLACES = 24, 17  # mirrors that are tried
FIRST = 12  # of them are moved to where they agree best
NEAR = 1.5  # cells: so near to a thing its mirror image is of it
AGREES = 0.93  # share of what is known at the mirror image that must be of the thing, and not empty
COVERS = 0.3  # share of a thing's cells that must lie elsewhere on it, mirrored
COSTS = 3.0  # of a cell that must not be there, in cells that lie on the thing
ALIKE = 0.8  # of the difference between colours anywhere on a thing, up to which its image has its colours
GAINS = 0.02  # share of its cells, mirrored, that must stand where nobody saw
MOST = 3  # mirrors of a thing


def mirrors_around(
    gaussians: Gaussians,
    centre: np.ndarray,
    radius: float,
    views: Sequence[Witness],
    planes: Sequence[Plane],
    photos: Mapping[str, np.ndarray],
) -> list[Mirror]:
    """Mirrors of the things that stand around what is removed, each on the largest plane, and end there.

    A mirror stands upright. It is taken where the image of what is seen of a thing lies on the thing, or where nobody
    looked, but not in empty space; where colours there are its own; and where it shows something that nobody saw.

    Args:
        gaussians: those that stay. centre: [3], the middle of what is removed. radius: of most of it.
        photos: view name -> uint8 [H, W, 3].
    """
    if not planes or not np.isfinite(radius):
        return []
    ground, cell = _largest(planes), CELL * radius
    up = ground.normal if centre @ ground.normal > ground.height else -ground.normal
    found: list[Mirror] = []
    for points in _things(centre, radius, up, views, planes):
        near = cKDTree(points).query(gaussians.means.double().cpu().numpy(), distance_upper_bound=ABOVE * cell)[0]
        own = torch.from_numpy(np.isfinite(near)).to(gaussians.means.device)
        chosen = _chosen(points, up, cell, views, photos)
        thing = _matte(gaussians.map(lambda p, own=own: p[own]), views) if chosen else None
        found += [Mirror(thing, *mirror) for mirror in chosen]
    return found


def _matte(gaussians: Gaussians, views: Sequence[Witness]) -> Gaussians:
    """The same in the mean colours that views show of them: from where no photograph was taken theirs are anything."""
    means = gaussians.means.double().cpu().numpy()
    total, count = torch.zeros_like(gaussians.means), torch.zeros_like(gaussians.means[:, :1])
    for view in views[:: max(1, len(views) // VIEWS)]:
        seen = torch.from_numpy(seen_by(view, means)).to(total)[:, None]
        total += seen * colors(gaussians, view.camera, gaussians.sh_degree)
        count += seen
    constant = torch.where(count > 0, (total / count.clamp_min(1) - 0.5) / SH0, gaussians.sh[:, 0])
    return replace(gaussians, sh=constant[:, None])


def _things(
    centre: np.ndarray, radius: float, up: np.ndarray, views: Sequence[Witness], planes: Sequence[Plane]
) -> list[np.ndarray]:
    """The middles [P, 3] of the cells of each thing: what views show above the ground, connected, within reach."""
    cell, points = CELL * radius, _standing(centre, radius, up, views, planes)
    if not len(points):
        return []
    at = np.floor(points / cell).astype(np.int64)
    at -= at.min(0)
    number, of, count = np.unique(np.ravel_multi_index(at.T, at.max(0) + 1), return_inverse=True, return_counts=True)
    middles = np.stack([np.bincount(of, points[:, k]) / count for k in range(3)], 1)
    said = votes(middles, views)
    there = said.shown & (count >= SEEN_SO_OFTEN) & (said.seen >= 2) & (said.seen > said.free)
    filled = np.zeros(at.max(0) + 1, bool)
    filled.ravel()[number[there]] = True
    thing = ndimage.label(filled, np.ones((3, 3, 3)))[0].ravel()[number[there]]
    parts = [middles[there][thing == k] for k in np.flatnonzero(np.bincount(thing, minlength=1) >= FEWEST) if k]
    ends = lambda part: (_away(part, centre, up) > REACH * radius - 2 * cell).mean() < OVER
    return [part for part in parts if ends(part)]


def _standing(
    centre: np.ndarray, radius: float, up: np.ndarray, views: Sequence[Witness], planes: Sequence[Plane]
) -> np.ndarray:
    """[P, 3], points of what views show within reach, above the largest plane, and off others along it."""
    seen = [np.zeros((0, 3))]
    for view in views[:: max(1, len(views) // VIEWS)]:
        depth = without_pits(view.depth, view.camera, planes)
        points = geometry.unproject(depth, view.camera)[::2, ::2][(~view.hidden & (depth > 0))[::2, ::2]]
        seen.append(points[_away(points, centre, up) < REACH * radius])
    points = np.concatenate(seen)
    for plane in planes:
        if abs(plane.normal @ up) > ALONG:
            points = points[np.abs(points @ plane.normal - plane.height) > ABOVE * CELL * radius]
    ground, height = _largest(planes), points @ up
    bottom = ground.height * (ground.normal @ up) + ABOVE * CELL * radius
    return points[(height > bottom) & (height < centre @ up + TOP * radius)]


def _largest(planes: Sequence[Plane]) -> Plane:
    return max(planes, key=lambda plane: int(plane.seen.sum()))


def _away(points: np.ndarray, centre: np.ndarray, up: np.ndarray) -> np.ndarray:
    """[P], how far points lie from the upright line through the centre."""
    off = points - centre
    return np.linalg.norm(off - (off @ up)[:, None] * up, axis=1)


def _chosen(
    points: np.ndarray, up: np.ndarray, cell: float, views: Sequence[Witness], photos: Mapping[str, np.ndarray]
) -> list[tuple[np.ndarray, float]]:
    """Normals and heights of a thing's mirrors, the one that shows most that nobody saw first."""
    agreeing, found, known = _agreeing(points, up, cell, views), [], points
    agreeing = _alike(points, agreeing, cell, _colors(points, views, photos)) if agreeing else []
    while agreeing and len(found) < MOST:
        gains = []
        for normal, height in agreeing:
            images = reflected(points, normal, height)
            said = votes(images, views)
            far = cKDTree(known).query(images, distance_upper_bound=NEAR * cell)[0] > NEAR * cell
            gains.append(images[far & ~said.shown & ~said.empty & (said.hidden > 0)])
        best = max(range(len(gains)), key=lambda k: len(gains[k]))
        if len(gains[best]) < GAINS * len(points):
            break
        found.append(agreeing[best])
        known = np.concatenate([known, gains[best]])
    return found


def _agreeing(
    points: np.ndarray, up: np.ndarray, cell: float, views: Sequence[Witness]
) -> list[tuple[np.ndarray, float]]:
    """Normals and heights of upright mirrors that what is known agrees with."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    second, tree = np.cross(up, first), cKDTree(points)
    asked = points[:: max(1, len(points) // ASKED)]
    some = views[:: max(1, len(views) // VIEWS)]
    normal_at = lambda angle: np.cos(angle) * first + np.sin(angle) * second

    def told(angle: float, height: float) -> tuple[float, float]:
        """Shares of the cells whose images lie elsewhere on the thing, and in empty space."""
        normal = normal_at(angle)
        moved = np.abs(asked @ normal - height) > NEAR * cell
        images = reflected(asked, normal, height)
        on = tree.query(images, distance_upper_bound=NEAR * cell)[0] < NEAR * cell
        return float((on & moved).mean()), float((votes(images, some).empty & ~on & moved).mean())

    def cost(mirror: Sequence[float]) -> float:
        on, bare = told(*mirror)
        return COSTS * bare - on

    tried = []
    for angle in np.linspace(0, np.pi, ANGLES, endpoint=False):
        low, high = np.percentile(points @ normal_at(angle), [10, 90])
        tried += [(angle, height) for height in np.linspace(low, high, PLACES)]
    found = []
    for angle, height in sorted(tried, key=cost)[:FIRST]:
        start = [[angle, height], [angle + 0.06, height], [angle, height + 2 * cell]]
        best = minimize(cost, start[0], method="Nelder-Mead", options={"initial_simplex": start, "maxfev": 40}).x
        on, bare = told(*best)
        if on > COVERS and on > AGREES * (on + bare):
            found.append((normal_at(best[0]), float(best[1])))
    return found


def _alike(
    points: np.ndarray, mirrors: Sequence[tuple[np.ndarray, float]], cell: float, colors: np.ndarray
) -> list[tuple[np.ndarray, float]]:
    """Those of the mirrors whose images have rather the colours [P, 3] of where they lie than of anywhere."""
    tree, anywhere, found = cKDTree(points), np.random.default_rng(0).permutation(len(points)), []
    for normal, height in mirrors:
        moved = np.abs(points @ normal - height) > NEAR * cell
        images = reflected(points, normal, height)
        far, at = tree.query(images, distance_upper_bound=NEAR * cell)
        on = np.flatnonzero(np.isfinite(far) & moved)
        if len(on) < FEWEST / 4:
            continue
        apart = np.abs(colors[on] - colors[at[on]]).mean(1)
        if np.median(apart) < ALIKE * np.median(np.abs(colors - colors[anywhere]).mean(1)):
            found.append((normal, height))
    return found


def _colors(points: np.ndarray, views: Sequence[Witness], photos: Mapping[str, np.ndarray]) -> np.ndarray:
    """[P, 3], mean colours of points in the views that show a surface there."""
    total, count = np.zeros((len(points), 3)), np.zeros(len(points))
    for view in views[:: max(1, len(views) // VIEWS)]:
        seen = seen_by(view, points)
        told, _ = geometry.sample_nearest(photos[view.camera.name], geometry.project(points, view.camera)[0])
        total[seen] += told[seen]
        count += seen
    return total / np.maximum(count, 1)[:, None]
