"""Find things beside the object that are their own mirror images, and the mirrors that show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from reffusion import geometry
from reffusion.background.mirrors import Mirror, reflect_points
from reffusion.background.plane import Plane, remove_reflected_depth
from reffusion.background.visibility import DepthView, count_views, is_seen
from reffusion.splat.conventions import SH0
from reffusion.splat.pure_torch import colors
from reffusion.types import Gaussians

REACH = 3.0  # radii of the object around its middle within which a thing must end
TOP = 1.25  # radii above the object's middle up to which things are considered: flowers in a vase are not its shape
CELL = 0.05  # of the object's radius: side of the cells that make up a thing
CLEARANCE = 2.5  # cells above the ground, and off planes parallel to it, from which something stands there
VIEWS = 12  # views in which things are looked for, at every second row and column
PARALLEL = 0.9  # cosine between normals above which a plane is parallel to the ground
MIN_POINTS = 3  # points in a cell of a thing
MIN_CELLS = 200  # cells of a thing
CUT_SHARE = 0.02  # of its cells at the border of the search region, from which a thing may continue beyond
TEST_CELLS = 400  # cells of a thing on which a mirror is tested
ANGLES, OFFSETS = 24, 17  # of the mirrors that are tried
REFINED = 12  # best mirrors that are refined by minimisation
NEAR = 1.5  # cells: a mirror image this close to the thing lies on it
MIN_AGREEMENT = 0.93  # share of the known part of the mirror image that must lie on the thing, not in free space
MIN_OVERLAP = 0.3  # share of a thing's cells whose images must lie elsewhere on it
FREE_COST = 3.0  # cost of a cell in free space, in cells that lie on the thing
COLOR_RATIO = 0.8  # of the colour difference between random places of a thing, below which its image has its colours
MIN_GAIN = 0.02  # share of a thing's cells whose images must lie where no photograph shows anything
MAX_MIRRORS = 3  # of a thing


def find_mirrors(
    gaussians: Gaussians,
    center: np.ndarray,
    radius: float,
    views: Sequence[DepthView],
    planes: Sequence[Plane],
    photos: Mapping[str, np.ndarray],
) -> list[Mirror]:
    """Upright mirrors of the things that stand on the largest plane around the removed object, and end there.

    A mirror is accepted where the image of the thing's observed part lies on the thing or where no view looks, but not
    in free space; where its colours agree; and where it shows something unobserved.

    Args:
        gaussians: those that remain. center: [3], the middle of the removed object. radius: the radius of most of it.
        photos: view name -> uint8 [H, W, 3].
    """
    if not planes or not np.isfinite(radius):
        return []
    ground, cell = _largest_plane(planes), CELL * radius
    up = ground.normal if center @ ground.normal > ground.offset else -ground.normal
    found: list[Mirror] = []
    for points in _find_things(center, radius, up, views, planes):
        distance = cKDTree(points).query(gaussians.means.double().cpu().numpy(), distance_upper_bound=CLEARANCE * cell)[
            0
        ]
        own = torch.from_numpy(np.isfinite(distance)).to(gaussians.means.device)
        mirrors = _select_mirrors(points, up, cell, views, photos)
        if mirrors:
            thing = _with_mean_colors(gaussians.map(lambda p, own=own: p[own]), views)
            found += [Mirror(thing, *mirror) for mirror in mirrors]
    return found


def _with_mean_colors(gaussians: Gaussians, views: Sequence[DepthView]) -> Gaussians:
    """The Gaussians in the mean colours that views show of them: their harmonics are arbitrary in directions from which
    no photograph was taken."""
    means = gaussians.means.double().cpu().numpy()
    total, count = torch.zeros_like(gaussians.means), torch.zeros_like(gaussians.means[:, :1])
    for view in views[:: max(1, len(views) // VIEWS)]:
        seen = torch.from_numpy(is_seen(view, means)).to(total)[:, None]
        total += seen * colors(gaussians, view.camera, gaussians.sh_degree)
        count += seen
    constant = torch.where(count > 0, (total / count.clamp_min(1) - 0.5) / SH0, gaussians.sh[:, 0])
    return replace(gaussians, sh=constant[:, None])


def _find_things(
    center: np.ndarray, radius: float, up: np.ndarray, views: Sequence[DepthView], planes: Sequence[Plane]
) -> list[np.ndarray]:
    """The cell centres [P, 3] of each thing: connected parts of what views show above the ground, within reach."""
    cell, points = CELL * radius, _standing_points(center, radius, up, views, planes)
    if not len(points):
        return []
    index = np.floor(points / cell).astype(np.int64)
    index -= index.min(0)
    number, of_point, count = np.unique(
        np.ravel_multi_index(index.T, index.max(0) + 1), return_inverse=True, return_counts=True
    )
    middles = np.stack([np.bincount(of_point, points[:, k]) / count for k in range(3)], 1)
    visibility = count_views(middles, views)
    solid = (
        visibility.is_observed & (count >= MIN_POINTS) & (visibility.seen >= 2) & (visibility.seen > visibility.free)
    )
    filled = np.zeros(index.max(0) + 1, bool)
    filled.ravel()[number[solid]] = True
    thing = ndimage.label(filled, np.ones((3, 3, 3)))[0].ravel()[number[solid]]
    parts = [middles[solid][thing == k] for k in np.flatnonzero(np.bincount(thing, minlength=1) >= MIN_CELLS) if k]
    ends = lambda part: (_distance_from_axis(part, center, up) > REACH * radius - 2 * cell).mean() < CUT_SHARE
    return [part for part in parts if ends(part)]


def _standing_points(
    center: np.ndarray, radius: float, up: np.ndarray, views: Sequence[DepthView], planes: Sequence[Plane]
) -> np.ndarray:
    """[P, 3], points that views show within reach, above the largest plane and off those parallel to it."""
    found = [np.zeros((0, 3))]
    for view in views[:: max(1, len(views) // VIEWS)]:
        depth = remove_reflected_depth(view.depth, view.camera, planes)
        points = geometry.unproject(depth, view.camera)[::2, ::2][(~view.masked & (depth > 0))[::2, ::2]]
        found.append(points[_distance_from_axis(points, center, up) < REACH * radius])
    points = np.concatenate(found)
    for plane in planes:
        if abs(plane.normal @ up) > PARALLEL:
            points = points[np.abs(points @ plane.normal - plane.offset) > CLEARANCE * CELL * radius]
    ground, height = _largest_plane(planes), points @ up
    bottom = ground.offset * (ground.normal @ up) + CLEARANCE * CELL * radius
    return points[(height > bottom) & (height < center @ up + TOP * radius)]


def _largest_plane(planes: Sequence[Plane]) -> Plane:
    return max(planes, key=lambda plane: int(plane.seen.sum()))


def _distance_from_axis(points: np.ndarray, center: np.ndarray, up: np.ndarray) -> np.ndarray:
    """[P], distance of points [P, 3] from the vertical line through the centre."""
    delta = points - center
    return np.linalg.norm(delta - (delta @ up)[:, None] * up, axis=1)


def _select_mirrors(
    points: np.ndarray, up: np.ndarray, cell: float, views: Sequence[DepthView], photos: Mapping[str, np.ndarray]
) -> list[tuple[np.ndarray, float]]:
    """(normal, offset) of a thing's mirrors, the one that shows most unobserved cells first."""
    candidates, found, known = _search_mirrors(points, up, cell, views), [], points
    if candidates:
        candidates = _with_matching_colors(points, candidates, cell, _mean_colors(points, views, photos))
    while candidates and len(found) < MAX_MIRRORS:
        gains = []
        for normal, offset in candidates:
            images = reflect_points(points, normal, offset)
            visibility = count_views(images, views)
            new = cKDTree(known).query(images, distance_upper_bound=NEAR * cell)[0] > NEAR * cell
            unobserved = ~visibility.is_observed & ~visibility.is_empty & (visibility.masked > 0)
            gains.append(images[new & unobserved])
        best = max(range(len(gains)), key=lambda k: len(gains[k]))
        if len(gains[best]) < MIN_GAIN * len(points):
            break
        found.append(candidates[best])
        known = np.concatenate([known, gains[best]])
    return found


def _search_mirrors(
    points: np.ndarray, up: np.ndarray, cell: float, views: Sequence[DepthView]
) -> list[tuple[np.ndarray, float]]:
    """(normal, offset) of upright mirrors that agree with what is known: grid search, then Nelder-Mead."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    second, tree = np.cross(up, first), cKDTree(points)
    tested = points[:: max(1, len(points) // TEST_CELLS)]
    some = views[:: max(1, len(views) // VIEWS)]
    normal_at = lambda angle: np.cos(angle) * first + np.sin(angle) * second

    def overlap_and_free(angle: float, offset: float) -> tuple[float, float]:
        """Shares of the cells whose images lie elsewhere on the thing, and in free space."""
        normal = normal_at(angle)
        moved = np.abs(tested @ normal - offset) > NEAR * cell
        images = reflect_points(tested, normal, offset)
        on_thing = tree.query(images, distance_upper_bound=NEAR * cell)[0] < NEAR * cell
        free = count_views(images, some).is_empty & ~on_thing & moved
        return float((on_thing & moved).mean()), float(free.mean())

    def cost(mirror: Sequence[float]) -> float:
        overlap, free = overlap_and_free(*mirror)
        return FREE_COST * free - overlap

    grid = []
    for angle in np.linspace(0, np.pi, ANGLES, endpoint=False):
        low, high = np.percentile(points @ normal_at(angle), [10, 90])
        grid += [(angle, offset) for offset in np.linspace(low, high, OFFSETS)]
    found = []
    for angle, offset in sorted(grid, key=cost)[:REFINED]:
        start = [[angle, offset], [angle + 0.06, offset], [angle, offset + 2 * cell]]
        best = minimize(cost, start[0], method="Nelder-Mead", options={"initial_simplex": start, "maxfev": 40}).x
        overlap, free = overlap_and_free(*best)
        if overlap > MIN_OVERLAP and overlap > MIN_AGREEMENT * (overlap + free):
            found.append((normal_at(best[0]), float(best[1])))
    return found


def _with_matching_colors(
    points: np.ndarray, mirrors: Sequence[tuple[np.ndarray, float]], cell: float, colors: np.ndarray
) -> list[tuple[np.ndarray, float]]:
    """Those of the mirrors whose images agree with the colours [P, 3] at their places better than random places do."""
    tree, shuffled, found = cKDTree(points), np.random.default_rng(0).permutation(len(points)), []
    for normal, offset in mirrors:
        moved = np.abs(points @ normal - offset) > NEAR * cell
        images = reflect_points(points, normal, offset)
        distance, nearest = tree.query(images, distance_upper_bound=NEAR * cell)
        on_thing = np.flatnonzero(np.isfinite(distance) & moved)
        if len(on_thing) < MIN_CELLS / 4:
            continue
        difference = np.abs(colors[on_thing] - colors[nearest[on_thing]]).mean(1)
        if np.median(difference) < COLOR_RATIO * np.median(np.abs(colors - colors[shuffled]).mean(1)):
            found.append((normal, offset))
    return found


def _mean_colors(points: np.ndarray, views: Sequence[DepthView], photos: Mapping[str, np.ndarray]) -> np.ndarray:
    """[P, 3], mean colours of points over the views that show a surface there."""
    total, count = np.zeros((len(points), 3)), np.zeros(len(points))
    for view in views[:: max(1, len(views) // VIEWS)]:
        seen = is_seen(view, points)
        color, _ = geometry.sample_nearest(photos[view.camera.name], geometry.project(points, view.camera)[0])
        total[seen] += color[seen]
        count += seen
    return total / np.maximum(count, 1)[:, None]
