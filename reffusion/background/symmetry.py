"""Search for things beside the object that are mirror-symmetric, and for their planes of mirror symmetry.

A *thing* is a connected part of the scene that stands on the largest plane (the ground) beside the removed object. The
thing is described by small cubic cells of space that contain points of its surface. A *mirror* is an upright plane that
maps a thing onto itself. It is given by (normal [3], offset) and consists of the points x with normal . x = offset.
"""

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

REACH = 3.0  # in radii of the object: distance from the vertical line through its middle within which a thing must end
TOP = 1.25  # in radii of the object: height above its middle at which things are cut, e.g. flowers in a vase
CELL = 0.05  # in radii of the object: side of a cell
CLEARANCE = 2.5  # cells: a point at most this far above the ground, or from a parallel plane, belongs to no thing
VIEWS = 12  # approximate number of views that are searched for things, at every second row and column
PARALLEL = 0.9  # cosine between normals above which a plane is parallel to the ground
MIN_POINTS = 3  # least number of points in a cell of a thing
MIN_CELLS = 200  # least number of cells of a thing
CUT_SHARE = 0.02  # a thing with this share of its cells at the border of the search region may continue beyond it
TEST_CELLS = 400  # approximate number of cells of a thing with which a mirror is tested
ANGLES, OFFSETS = 24, 17  # number of angles and of offsets in the grid of mirrors that are tried
REFINED = 12  # number of mirrors of the grid, the best ones, that are refined by minimization
NEAR = 1.5  # in cells: a mirror image within this distance of a cell of the thing lies on the thing
MIN_AGREEMENT = 0.93  # of the images that lie on the thing or in free space, least share that lie on the thing
MIN_OVERLAP = 0.3  # least share of a thing's cells whose mirror images lie on the thing, away from the mirror
FREE_COST = 3.0  # cost of an image in free space, relative to the gain of an image on the thing
COLOR_RATIO = 0.8  # images agree in color if they differ by less than this many times what random places differ by
MIN_GAIN = 0.02  # least share of a thing's cells whose mirror images lie where no photograph shows anything
MAX_MIRRORS = 3  # largest number of mirrors of a thing


def find_mirrors(
    gaussians: Gaussians,
    center: np.ndarray,
    radius: float,
    views: Sequence[DepthView],
    planes: Sequence[Plane],
    photos: Mapping[str, np.ndarray],
) -> list[Mirror]:
    """Find the upright mirrors of the things that stand on the largest plane around the removed object.

    Things that may continue beyond the search region are left out. A mirror is accepted if the mirror image of the
    thing's visible part overlaps the thing and lies otherwise where no view looks, hardly in free space; if the colors
    of the mirror image agree with the thing's colors; and if the mirror image shows something behind the removed
    object that no photograph shows.

    Args:
        gaussians: the Gaussians of the scene without the removed ones.
        center: [3], the middle of the removed object.
        radius: radius around the center that contains most of the removed object.
        views: depth of the training views, rendered with the object.
        planes: the planes around the object.
        photos: view name -> uint8 [H, W, 3].

    Returns:
        The mirrors of all things; none if there is no plane or the radius is infinite (nothing is removed).
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
    """Return the Gaussians with harmonics of degree 0: the mean colors in the views that show them, else as it was."""
    means = gaussians.means.double().cpu().numpy()
    total, count = torch.zeros_like(gaussians.means), torch.zeros_like(gaussians.means[:, :1])
    # A mirror image shows a Gaussian from directions without a photograph, where its harmonics are arbitrary.
    for view in views[:: max(1, len(views) // VIEWS)]:
        seen = torch.from_numpy(is_seen(view, means)).to(total)[:, None]
        total += seen * colors(gaussians, view.camera, gaussians.sh_degree)
        count += seen
    constant = torch.where(count > 0, (total / count.clamp_min(1) - 0.5) / SH0, gaussians.sh[:, 0])
    return replace(gaussians, sh=constant[:, None])


def _find_things(
    center: np.ndarray, radius: float, up: np.ndarray, views: Sequence[DepthView], planes: Sequence[Plane]
) -> list[np.ndarray]:
    """Return the things beside the object: for each connected group of cells, their mean surface points [P, 3]."""
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
    """Return the surface points [P, 3] outside the masks that may belong to things that stand on the ground."""
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
    """Return the plane with most seen cells, which is taken for the ground."""
    return max(planes, key=lambda plane: int(plane.seen.sum()))


def _distance_from_axis(points: np.ndarray, center: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return [P], the distances of points [P, 3] from the line through `center` along the unit vector `up`."""
    delta = points - center
    return np.linalg.norm(delta - (delta @ up)[:, None] * up, axis=1)


def _select_mirrors(
    points: np.ndarray, up: np.ndarray, cell: float, views: Sequence[DepthView], photos: Mapping[str, np.ndarray]
) -> list[tuple[np.ndarray, float]]:
    """Return up to `MAX_MIRRORS` mirrors (normal, offset) of a thing; the first shows most unobserved cells."""
    candidates, found, known = _search_mirrors(points, up, cell, views), [], points
    if candidates:
        candidates = _with_matching_colors(points, candidates, cell, _mean_colors(points, views, photos))
    while candidates and len(found) < MAX_MIRRORS:
        gains = []
        for normal, offset in candidates:
            images = reflect_points(points, normal, offset)
            visibility = count_views(images, views)
            # a further mirror must show unobserved cells that the mirrors before it do not show
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
    """Return upright mirrors (normal, offset) whose images of the thing lie on the thing, hardly in free space."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    second, tree = np.cross(up, first), cKDTree(points)
    tested = points[:: max(1, len(points) // TEST_CELLS)]
    some = views[:: max(1, len(views) // VIEWS)]
    normal_at = lambda angle: np.cos(angle) * first + np.sin(angle) * second

    def overlap_and_free(angle: float, offset: float) -> tuple[float, float]:
        """Return the share of cells whose images lie on the thing, and the share whose images lie in free space.

        Cells close to the mirror count in neither share, because their images are almost where the cells are.
        """
        normal = normal_at(angle)
        moved = np.abs(tested @ normal - offset) > NEAR * cell
        images = reflect_points(tested, normal, offset)
        on_thing = tree.query(images, distance_upper_bound=NEAR * cell)[0] < NEAR * cell
        free = count_views(images, some).is_empty & ~on_thing & moved
        return float((on_thing & moved).mean()), float(free.mean())

    def cost(mirror: Sequence[float]) -> float:
        """Return the cost of a mirror, given by (angle in radians, offset); a good mirror has a low cost."""
        overlap, free = overlap_and_free(*mirror)
        return FREE_COST * free - overlap

    # grid search over angles and offsets, refined by Nelder-Mead; colors are not compared
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
    """Return the mirrors whose images have about the colors of the cells of the thing on which they lie."""
    tree, shuffled, found = cKDTree(points), np.random.default_rng(0).permutation(len(points)), []
    for normal, offset in mirrors:
        moved = np.abs(points @ normal - offset) > NEAR * cell
        images = reflect_points(points, normal, offset)
        distance, nearest = tree.query(images, distance_upper_bound=NEAR * cell)
        on_thing = np.flatnonzero(np.isfinite(distance) & moved)
        if len(on_thing) < MIN_CELLS / 4:
            continue
        difference = np.abs(colors[on_thing] - colors[nearest[on_thing]]).mean(1)
        # compared with the difference between random cells
        if np.median(difference) < COLOR_RATIO * np.median(np.abs(colors - colors[shuffled]).mean(1)):
            found.append((normal, offset))
    return found


def _mean_colors(points: np.ndarray, views: Sequence[DepthView], photos: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return [P, 3], the mean colors, 0 to 255, of the points in the views that show them; 0 if no view does."""
    total, count = np.zeros((len(points), 3)), np.zeros(len(points))
    for view in views[:: max(1, len(views) // VIEWS)]:
        seen = is_seen(view, points)
        color, _ = geometry.sample_nearest(photos[view.camera.name], geometry.project(points, view.camera)[0])
        total[seen] += color[seen]
        count += seen
    return total / np.maximum(count, 1)[:, None]
