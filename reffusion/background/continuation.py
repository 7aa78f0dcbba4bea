"""Find the planes around a hole, and where each continues into space that no photograph shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from scipy import ndimage

from reffusion import geometry, morphology, seeding
from reffusion.background.borders import RIM, extend_borders
from reffusion.background.corners import find_third_faces, visible_past
from reffusion.background.plane import CELLS, Plane
from reffusion.background.plane_fit import MAX_TURN, ransac_plane, refine_by_points, sample_surfaces
from reffusion.background.visibility import SURFACE, DepthView, count_views, is_seen
from reffusion.gaussians.surfels import surface_normals
from reffusion.types import Camera

REACH = 2.5  # radii of the object: surfaces this close to its middle are considered
INLIER = 0.08  # of the object's radius: distance within which a sample belongs to a plane
MIN_SPREAD = 0.25  # of the object's radius: least standard deviation, in every direction, of points that refine a plane
MIN_SHARE = 0.1  # of all samples that a plane must explain
MAX_PLANES = 5
MIN_PATCH = 0.05  # of the largest patch of seen cells: smaller patches do not belong to the plane
ALIGN_INLIER = (0.05, 0.03, 0.015, 0.015)  # relative depth within which a view's pixels belong to a plane, step by step
ALIGN_PIXELS = 200  # pixels that must belong to it
ALIGN_LIMIT = 0.08  # relative depth: a plane that would move further anywhere in the hole stays where it is
ALIGN_PRIOR = 0.05  # weight of the plane's old position inside the hole, against the pixels around it
CROSSING = 0.9  # cosine of the angle between two planes below which they cross
NORMAL_RATIO = 1.0  # cosine to one plane over that to another, from which a surface belongs to the first
NORMAL_SMOOTHING = 0.01  # of the image's width: scale at which a surface's normal is measured
WIDER_MAP = 2.0  # factor by which the map is wider on which enclosed patches are detected
MIN_REFLECTION = 0.03  # of the seen cells: smaller enclosed patches are unevenness, not mirrors
MIN_HOLE = 0.01  # of the seen cells: smaller patches that views see through are depth errors
ENCLOSED = 0.8  # share of a free patch's border that must be seen for it to be enclosed: a recess has less
TOUCHING = 0.25  # share of an unobserved patch's border that must be seen for the plane to continue into it


def find_planes(
    center: np.ndarray, radius: float, views: Sequence[DepthView], points: np.ndarray, seed: int = 0
) -> list[Plane]:
    """The planes around the removed object, those with most samples first.

    Planes are fitted in the world to the surfaces that several views show around their masks: the depth of one view is
    rough, and a plane that is oblique in one view is frontal in another. Sparse points refine a plane's position where
    enough of them lie sharply on it (`plane_fit.refine_by_points`).

    Args:
        center: [3], the middle of the removed object. radius: the radius of most of it.
        points: [P, 3], the scene's sparse points; P = 0 is allowed.
        seed: of the RANSAC draws.
    """
    samples = sample_surfaces(center, REACH * radius, views, seed)
    points = points[np.linalg.norm(points - center, axis=1) < REACH * radius]
    inlier, unexplained = INLIER * radius, np.ones(len(samples), bool)
    distance = float(np.median([np.linalg.norm(view.camera.center - center) for view in views])) if views else 0.0
    found: list[tuple[np.ndarray, float]] = []
    generator = np.random.default_rng(seeding.seed_for(seed, "planes around"))
    while unexplained.sum() >= max(50, MIN_SHARE * len(samples)) and len(found) < MAX_PLANES:
        normal, offset, support = ransac_plane(samples[unexplained], inlier, generator)
        if support < MIN_SHARE * len(samples):
            break
        refined = refine_by_points(normal, offset, points, inlier, MIN_SPREAD * radius)
        new_normal, new_offset = refined or (normal, offset)
        if refined or not _is_duplicate(normal, offset, found, center, SURFACE * distance):
            found.append((new_normal, new_offset))
        # The points of a plane lie about its refined position, its samples about the rendered one.
        points = points[np.abs(points @ new_normal - new_offset) >= 1.5 * inlier]
        unexplained &= np.abs(samples @ normal - offset) >= 1.5 * inlier
    thirds = find_third_faces(samples, unexplained, found, center, radius, inlier)
    is_third = [False] * len(found) + [True] * len(thirds)
    found += thirds
    band = max(1.5 * inlier, SURFACE * distance)
    maps = [
        _map_plane(*plane, center, REACH * radius, views, third) for plane, third in zip(found, is_third, strict=True)
    ]
    planes = [plane for plane, _ in maps]
    grounds = [_crossing(plane, planes[:k]) for k, plane in enumerate(planes)]
    # Cells near a crossing could belong to either plane. They belong to the one with more samples, unless most views
    # show a surface there that faces as the other plane does.
    facing = _cells_facing(planes, grounds, views)
    complete: list[Plane] = []
    for (plane, occluded), own_grounds, own_cells, third in zip(maps, grounds, facing, is_third, strict=True):
        own = replace(plane, seen=plane.seen & own_cells)
        if third:
            occluded &= visible_past(own, complete, views)
        complete.append(_continue_plane(own, occluded, own_grounds, _crossing(own, planes), band, third))
    return complete


def _is_duplicate(
    normal: np.ndarray, offset: float, planes: Sequence[tuple[np.ndarray, float]], center: np.ndarray, distance: float
) -> bool:
    """Whether a plane without sparse points repeats one of `planes`, parallel to it within the `distance` that views
    can tell apart."""
    for other, other_offset in planes:
        foot = center - (center @ other - other_offset) * other
        if abs(normal @ other) > MAX_TURN and abs(normal @ foot - offset) < distance:
            return True
    return False


def _crossing(plane: Plane, others: Sequence[Plane]) -> list[Plane]:
    return [other for other in others if abs(other.normal @ plane.normal) < CROSSING]


def align_plane(plane: Plane, depth: np.ndarray, camera: Camera, hole: np.ndarray) -> Plane:
    """The plane moved onto the depth that one view knows around a hole; unchanged where too few pixels tell.

    Args:
        depth: [H, W], accurate where above 0.
        hole: bool [H, W], where the plane may continue. There its old position is a weak prior.
    """
    plane_depth = plane.depth(camera)
    known = (depth > 0) & np.isfinite(plane_depth)
    rows, columns = np.nonzero(known | (hole & np.isfinite(plane_depth)))
    x, y = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
    design, prior = np.stack([x, y, np.ones_like(x)], 1), 1 / plane_depth[rows, columns]
    is_known, values = known[rows, columns], np.where(known, 1 / np.maximum(depth, 1e-12), 0)[rows, columns]
    solution = np.linalg.lstsq(design, prior, rcond=None)[0] if len(rows) >= 3 else np.zeros(3)
    for tolerance in ALIGN_INLIER:
        residual = np.abs(values / np.maximum(design @ solution, 1e-12) - 1)
        inlier = is_known & (residual < tolerance)
        if inlier.sum() < ALIGN_PIXELS:
            return plane
        outside = np.where(is_known, 0.0, ALIGN_PRIOR / max((~is_known).sum(), 1))
        weight = np.where(inlier, 1 / inlier.sum(), outside) / prior**2
        scaled = design * np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq(scaled, np.where(inlier, values, prior) * np.sqrt(weight), rcond=None)[0]
    normal = solution @ camera.world_to_camera[:3, :3]
    length = np.linalg.norm(normal)
    normal, offset = normal / length, (1 + normal @ camera.center) / length
    aligned = replace(plane, normal=normal, offset=float(offset))
    inside = hole & np.isfinite(plane_depth)
    shift = np.abs(aligned.depth(camera)[inside] / plane_depth[inside] - 1).max() if inside.any() else 0.0
    return aligned if shift < ALIGN_LIMIT else plane


def _continued_hull(plane: Plane, seen: np.ndarray, grounds: Sequence[Plane]) -> np.ndarray:
    """bool [CELLS, CELLS]: the convex hull of the large patches of seen cells, since a surface ends where its visible
    borders, extended, do. What stands on one of the `grounds`, planes that it crosses, reaches down to it."""
    patches, count = ndimage.label(_without_rims(seen))
    areas = np.bincount(patches.ravel(), minlength=count + 1)
    areas[0] = 0
    large = (areas >= MIN_PATCH * max(areas.max(), 1))[patches]
    standing = plane.cell_centers[large]
    for other in grounds:
        down = other.normal - (other.normal @ plane.normal) * plane.normal
        feet = standing + ((other.offset - standing @ other.normal) / (down @ down))[:, None] * down
        large[tuple(plane.cell_index(feet).clip(0, CELLS - 1).T)] = True
    return morphology.convex_hull(large)


def _without_rims(seen: np.ndarray) -> np.ndarray:
    """bool [CELLS, CELLS]: seen cells without thin strips."""
    return cv2.morphologyEx(seen.astype(np.uint8), cv2.MORPH_OPEN, morphology.square(RIM)) > 0


def _map_plane(
    normal: np.ndarray, offset: float, center: np.ndarray, reach: float, views: Sequence[DepthView], third: bool
) -> tuple[Plane, np.ndarray]:
    """The plane with its map of seen, free and reflective cells; and bool [CELLS, CELLS], cells that the object
    occludes in some view."""
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    axes = np.stack([first / np.linalg.norm(first), np.cross(normal, first / np.linalg.norm(first))])
    origin, cell_size = center - (center @ normal - offset) * normal, 2 * reach / CELLS
    empty = np.zeros((CELLS, CELLS), bool)
    plane = Plane(normal, offset, origin, axes, cell_size, empty, empty, empty, empty, empty)
    # The plane is looked at from the object's side: the underside of a table, seen from below, is not the top under the
    # object. Where no camera is on that side (a table's top beside something lower), from the other side.
    facing = normal if center @ normal > offset else -normal
    if not any(view.camera.center @ facing > plane.origin @ facing for view in views):
        facing = -facing
    seen, free, occluded = _cell_visibility(plane, facing, views)
    # An object in front of a wall's edge is on both sides of a third face: the side from which more is seen counts.
    if third and (other := _cell_visibility(plane, -facing, views))[0].sum() > seen.sum():
        facing, (seen, free, occluded) = -facing, other
    wide = replace(plane, cell_size=WIDER_MAP * cell_size)
    enclosed = wide.contains(
        _enclosed_patches(*_cell_visibility(wide, facing, views)[:2]), plane.cell_centers.reshape(-1, 3)
    )
    reflective = free & ndimage.binary_dilation(enclosed.reshape(free.shape), iterations=2)
    free = free & ~_small_holes(free, MIN_HOLE * seen.sum())
    return replace(plane, seen=seen, free=free, reflective=reflective), occluded


def _small_holes(free: np.ndarray, min_cells: float) -> np.ndarray:
    """bool [CELLS, CELLS]: patches of fewer than `min_cells` free cells. Depth errs beside the object's edge."""
    patches, count = ndimage.label(np.pad(free, 1, constant_values=True))  # a patch may continue beyond the map
    areas = np.bincount(patches.ravel(), minlength=count + 1)
    return free & (areas < min_cells)[patches][1:-1, 1:-1]


def _cell_visibility(
    plane: Plane, facing: np.ndarray, views: Sequence[DepthView]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """bool [CELLS, CELLS] each: cells where views on the side of `facing`, [3], show the plane, where views see through
    it, and where the object occludes it in some view."""
    normals = np.broadcast_to(facing, (CELLS * CELLS, 3))
    visibility = count_views(plane.cell_centers.reshape(-1, 3), views, normals)
    seen = (visibility.seen >= 1) & (visibility.seen >= visibility.free)
    seen, empty, hidden = (each.reshape(CELLS, CELLS) for each in (seen, visibility.is_empty, visibility.masked > 0))
    return seen, empty, hidden


def _enclosed_patches(seen: np.ndarray, free: np.ndarray) -> np.ndarray:
    """bool [CELLS, CELLS]: the large patches of free cells that seen cells surround."""
    patches, count = ndimage.label(np.pad(free, 1, constant_values=True))
    found = np.zeros(patches.shape, bool)
    padded = np.pad(seen, 1)
    for patch in set(range(1, count + 1)) - {patches[0, 0]}:
        inside = patches == patch
        border = ndimage.binary_dilation(inside) & ~inside
        large = inside.sum() > MIN_REFLECTION * seen.sum()
        found |= inside & (large and padded[border].mean() > ENCLOSED)
    return found[1:-1, 1:-1]


def _continue_plane(
    plane: Plane, occluded: np.ndarray, grounds: Sequence[Plane], others: Sequence[Plane], band: float, third: bool
) -> Plane:
    """The plane with the cells into which it continues.

    It continues into an unobserved patch that the object occludes and that touches seen cells, up to its extended
    border; not where views see through it.

    Args:
        occluded: bool [CELLS, CELLS], cells that the object occludes.
        others: planes that cross it. grounds: those of them with more samples.
        band: distance to `others` within which a view that seems to show this plane may show the other.
        third: only known cells of a patch's border decide whether it touches: most of the rest is inside walls.
    """
    # Neither thin rims nor crossings tell where the plane continues.
    seen, free = plane.seen | plane.reflective, plane.free & ~plane.reflective
    own = seen.copy()
    for other in others if not third else ():
        own &= np.abs(plane.cell_centers @ other.normal - other.offset) >= band
    unknown = ~seen & ~free & occluded
    patches, count = ndimage.label(unknown)
    continued, beyond_border = np.zeros((2, *occluded.shape), bool)
    for patch in range(1, count + 1):
        inside = patches == patch
        border = ndimage.binary_dilation(inside, iterations=2) & ~inside
        decisive = border & (seen | free) if third else border
        if inside.sum() >= 4 and seen[decisive].sum() > TOUCHING * decisive.sum():
            beyond = extend_borders(inside, _without_rims(own), free) < 0.5
            continued |= inside & ~beyond
            beyond_border |= inside & beyond
    continued &= _continued_hull(plane, own if grounds else seen, grounds)
    enclosed = ndimage.binary_fill_holes(seen | continued) & ~seen & ~beyond_border & occluded
    return replace(plane, continued=continued, enclosed=continued | enclosed)


def _cells_facing(
    planes: Sequence[Plane], grounds: Sequence[Sequence[Plane]], views: Sequence[DepthView]
) -> list[np.ndarray]:
    """For each plane bool [CELLS, CELLS]: cells where most views that show a surface show one whose normal is closer to
    the plane's than to that of its grounds, which cross it; all cells where it has none.

    The normals of one view take more memory than everything else of it, so they exist for one view at a time.
    """
    cells = [plane.cell_centers.reshape(-1, 3) for plane in planes]
    agreeing, visible = ([np.zeros(len(points), np.int64) for points in cells] for _ in range(2))
    for view in views if any(grounds) else ():
        normals = _smooth_normals(view)
        for k, (plane, own_grounds) in enumerate(zip(planes, grounds, strict=True)):
            if not own_grounds:
                continue
            seen = is_seen(view, cells[k])
            normal, _ = geometry.sample_nearest(normals, geometry.project(cells[k], view.camera)[0])
            other = np.max([np.abs(normal @ each.normal) for each in own_grounds], 0)
            visible[k] += seen
            agreeing[k] += seen & (np.abs(normal @ plane.normal) > NORMAL_RATIO * other)
    return [
        (2 * agreeing[k] > visible[k]).reshape(plane.seen.shape) if grounds[k] else np.ones_like(plane.seen)
        for k, plane in enumerate(planes)
    ]


def _smooth_normals(view: DepthView) -> np.ndarray:
    """[H, W, 3] unit normals of a view's surface, smoothed over rough ground."""
    sigma = NORMAL_SMOOTHING * view.depth.shape[1]
    known = (view.depth > 0) & ~view.masked
    weight = ndimage.gaussian_filter(known.astype(np.float64), sigma)
    disparity = np.where(known, geometry.reciprocal(view.depth.astype(np.float64)), 0)
    smooth = ndimage.gaussian_filter(disparity, sigma)
    return surface_normals(geometry.reciprocal(smooth / np.maximum(weight, 1e-9)), view.camera)
