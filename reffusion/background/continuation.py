"""Search for the planes around a hole, and for the cells into which each of them continues behind the object.

Each plane has a map of square cells (`plane.Plane`). A cell is *seen* where views show the plane, *free* where views
see through the plane, and unknown otherwise. The plane continues into some of the unknown cells.
"""

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
from reffusion.background.plane_fit import MAX_TURN, refine_by_points, sample_surfaces, search_planes
from reffusion.background.visibility import DepthView, count_views, is_seen
from reffusion.gaussians.surfels import surface_normals
from reffusion.types import Camera

REACH = 2.5  # in radii of the object: surfaces up to this distance from the middle of the object are considered
INLIER = 0.08  # in radii of the object: distance within which a sample belongs to a plane
MIN_SPREAD = 0.25  # in radii of the object: `min_spread` of `plane_fit.refine_by_points`
CLAIMED = 1.5  # inlier distances within which samples and sparse points belong to a plane, and to no later one
MIN_SHARE, MIN_SAMPLES = 0.1, 50  # least share of all samples, and least number, that must lie on a plane
MAX_PLANES = 5
MIN_PATCH = 0.05  # area relative to the largest patch of seen cells, below which a patch does not belong to the plane
ALIGN_INLIER = (0.05, 0.03, 0.015, 0.015)  # relative depth error below which a pixel is an inlier, in successive fits
ALIGN_PIXELS = 200  # least number of inlier pixels
ALIGN_LIMIT = 0.08  # relative depth: a plane that would move further anywhere in the hole is not moved
ALIGN_PRIOR = 0.05  # weight of all pixels of the plane's old position in the hole; all inliers around have weight 1
CROSSING = 0.9  # cosine of the angle between two planes' normals below which they cross
# A surface belongs to a plane, and not to another one, if the cosine between its normal and that of the plane is more
# than this many times the cosine with the other normal.
NORMAL_RATIO = 1.0
NORMAL_SMOOTHING = 0.01  # of the image's width: standard deviation of the blur with which normals are measured
WIDER_MAP = 2.0  # enclosed patches are detected on a map that is wider by this factor
MIN_REFLECTION = 0.03  # of the area of the seen cells: smaller enclosed patches are uneven places, not mirrors
MIN_HOLE = 0.01  # of the area of the seen cells: smaller patches of free cells are depth errors
ENCLOSED = 0.8  # a free patch is enclosed if a larger share of its border is seen; for a recess the share is smaller
TOUCHING = 0.25  # a plane continues into an unknown patch only if a larger share of the patch's border is seen


def find_planes(center: np.ndarray, radius: float, views: Sequence[DepthView], points: np.ndarray) -> list[Plane]:
    """Find the planes around the removed object, with the cells into which they continue.

    Planes are fitted by RANSAC to samples, i.e. points of the surfaces around the masks, taken from several views. One
    view would not suffice, because its depth is rough, and a plane that is oblique in one view is frontal in another.
    Sparse points refine a plane if enough of them lie sharply on it (`plane_fit.refine_by_points`). Third faces of
    corners are added (`corners.find_third_faces`).

    Args:
        center: [3], the middle of the removed object.
        radius: radius around the center that contains most of the removed object.
        views: depth of the training views, rendered with the object.
        points: [P, 3], the scene's sparse points; P = 0 is allowed.

    Returns:
        Up to `MAX_PLANES` planes in the order in which RANSAC found them, about by decreasing number of samples; then
        the third faces. The list is empty if there are too few samples.
    """
    samples = sample_surfaces(center, REACH * radius, views)
    points = points[np.linalg.norm(points - center, axis=1) < REACH * radius]
    inlier, unexplained = INLIER * radius, np.ones(len(samples), bool)
    distance = float(np.median([np.linalg.norm(view.camera.center - center) for view in views])) if views else 0.0
    found: list[tuple[np.ndarray, float]] = []
    generator = np.random.default_rng(seeding.seed_for(0, "planes around"))
    least = max(MIN_SAMPLES, MIN_SHARE * len(samples))
    for normal, offset in search_planes(samples, inlier, generator, least, CLAIMED):
        refined = refine_by_points(normal, offset, points, inlier, MIN_SPREAD * radius)
        new_normal, new_offset = refined or (normal, offset)
        if refined or not _is_duplicate(normal, offset, found, center, geometry.SAME_SURFACE * distance):
            found.append((new_normal, new_offset))
        # Sparse points lie around the refined plane, samples around the plane that was fitted to them.
        points = points[np.abs(points @ new_normal - new_offset) >= CLAIMED * inlier]
        unexplained &= np.abs(samples @ normal - offset) >= CLAIMED * inlier
        if len(found) == MAX_PLANES:
            break
    thirds = find_third_faces(samples, unexplained, found, center, radius, inlier)
    is_third = [False] * len(found) + [True] * len(thirds)
    found += thirds
    band = max(CLAIMED * inlier, geometry.SAME_SURFACE * distance)
    maps = [
        _map_plane(*plane, center, REACH * radius, views, third) for plane, third in zip(found, is_third, strict=True)
    ]
    planes = [plane for plane, _ in maps]
    grounds = [_crossing(plane, planes[:k]) for k, plane in enumerate(planes)]
    # Cells near the intersection of two planes could belong to either of them. They belong to the plane with more
    # samples, unless most views show a surface there with the normal of the other plane.
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
    """Return whether the plane normal . x = offset is parallel to one of `planes`, within `distance` near `center`."""
    for other, other_offset in planes:
        foot = center - (center @ other - other_offset) * other
        # Without refinement by sparse points, the position is only as precise as the views, hence the tolerance.
        if abs(normal @ other) > MAX_TURN and abs(normal @ foot - offset) < distance:
            return True
    return False


def _crossing(plane: Plane, others: Sequence[Plane]) -> list[Plane]:
    """Return those of the other planes that cross the plane, i.e. that are not about parallel to it."""
    return [other for other in others if abs(other.normal @ plane.normal) < CROSSING]


def align_plane(plane: Plane, depth: np.ndarray, camera: Camera, hole: np.ndarray) -> Plane:
    """Return a plane, moved onto the depth of one view around a hole.

    The disparity of a plane is an affine function of the pixel. The function is fitted to the pixels around the hole
    that are inliers, with the plane's old position inside the hole as a weak prior.

    Args:
        depth: [H, W], accurate camera z of the pixels around the hole; 0 where unknown. All pixels above 0 count.
        camera: the view.
        hole: bool [H, W], True where the plane may continue.

    Returns:
        The moved plane with the same cells; the given plane if fewer than `ALIGN_PIXELS` pixels are inliers, or if the
        depth anywhere in the hole would change by `ALIGN_LIMIT` of its value or more.
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
    """Return the convex hull [CELLS, CELLS] of a plane's large seen patches, the region in which it may continue."""
    patches, areas = morphology.label_sizes(_without_rims(seen))
    large = (areas >= MIN_PATCH * max(areas.max(), 1))[patches]
    standing = plane.cell_centers[large]
    # The surface may stand on `grounds`, planes that cross it and have more samples. Seen cells are projected down onto
    # them, so that e.g. a wall continues down to the floor.
    for other in grounds:
        down = other.normal - (other.normal @ plane.normal) * plane.normal
        feet = standing + ((other.offset - standing @ other.normal) / (down @ down))[:, None] * down
        large[tuple(plane.cell_index(feet).clip(0, CELLS - 1).T)] = True
    return morphology.convex_hull(large)


def _without_rims(seen: np.ndarray) -> np.ndarray:
    """Return the seen cells, bool [CELLS, CELLS], without strips up to 2 RIM cells wide."""
    return cv2.morphologyEx(seen.astype(np.uint8), cv2.MORPH_OPEN, morphology.square(RIM)) > 0


def _map_plane(
    normal: np.ndarray, offset: float, center: np.ndarray, reach: float, views: Sequence[DepthView], third: bool
) -> tuple[Plane, np.ndarray]:
    """Return the plane with its map, not yet continued, and the cells [CELLS, CELLS] that the object's mask covers."""
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    axes = np.stack([first / np.linalg.norm(first), np.cross(normal, first / np.linalg.norm(first))])
    # `center`, the middle of the removed object, is projected onto the middle of the map; `reach` is half its side.
    origin, cell_size = center - (center @ normal - offset) * normal, 2 * reach / CELLS
    empty = np.zeros((CELLS, CELLS), bool)
    plane = Plane(normal, offset, origin, axes, cell_size, empty, empty, empty, empty, empty)
    # Only views on one side of the plane count, because the underside of a table is no evidence of its top. This is the
    # object's side, or the other side if no camera is on the object's side (e.g. a table's top beside a lower object).
    facing = normal if center @ normal > offset else -normal
    if not any(view.camera.center @ facing > plane.origin @ facing for view in views):
        facing = -facing
    seen, free, occluded = _cell_visibility(plane, facing, views)
    # An object at the edge of a wall lies on both sides of a third face of a corner. Then the side counts from which
    # more is seen.
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
    """Return bool [CELLS, CELLS], the patches of fewer than `min_cells` free cells; none at the map's border."""
    # Depth errors beside the object's edge make small patches. A patch at the map's border may continue beyond the map.
    # the padding joins all patches at the map's border
    patches, areas = morphology.label_sizes(np.pad(free, 1, constant_values=True))
    return free & (areas < min_cells)[patches][1:-1, 1:-1]


def _cell_visibility(
    plane: Plane, facing: np.ndarray, views: Sequence[DepthView]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return three cell masks: seen from the side of `facing`, seen through from either side, hidden by the object."""
    normals = np.broadcast_to(facing, (CELLS * CELLS, 3))
    visibility = count_views(plane.cell_centers.reshape(-1, 3), views, normals)
    seen = (visibility.seen >= 1) & (visibility.seen >= visibility.free)
    seen, empty, hidden = (each.reshape(CELLS, CELLS) for each in (seen, visibility.is_empty, visibility.masked > 0))
    return seen, empty, hidden


def _enclosed_patches(seen: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return bool [CELLS, CELLS], the large patches of free cells that seen cells enclose; none at the map's border."""
    patches, count = ndimage.label(np.pad(free, 1, constant_values=True))
    found = np.zeros(patches.shape, bool)
    padded = np.pad(seen, 1)
    # A mirror or a window in the plane is such a patch: views seem to see through the plane there.
    for patch in set(range(1, count + 1)) - {patches[0, 0]}:
        inside = patches == patch
        border = ndimage.binary_dilation(inside) & ~inside
        large = inside.sum() > MIN_REFLECTION * seen.sum()
        found |= inside & (large and padded[border].mean() > ENCLOSED)
    return found[1:-1, 1:-1]


def _continue_plane(
    plane: Plane, occluded: np.ndarray, grounds: Sequence[Plane], others: Sequence[Plane], band: float, third: bool
) -> Plane:
    """Return the plane with `continued` and `enclosed`, the cells into which it continues behind the object."""
    # Reflective cells, through which views see only because the plane is a mirror there, count as seen.
    # Seen cells within `band` (world units) of another plane, where a view may confuse the two, and thin strips of seen
    # cells do not determine the borders of the plane.
    seen, free = plane.seen | plane.reflective, plane.free & ~plane.reflective
    own = seen.copy()
    for other in others if not third else ():
        own &= np.abs(plane.cell_centers @ other.normal - other.offset) >= band
    unknown = ~seen & ~free & occluded
    patches, count = ndimage.label(unknown)
    continued, beyond_border = np.zeros((2, *occluded.shape), bool)
    # The plane continues into a patch if enough of the patch's border is seen. It ends at its visible borders, which
    # are extended straight, and at the border of `_continued_hull`.
    for patch in range(1, count + 1):
        inside = patches == patch
        border = ndimage.binary_dilation(inside, iterations=2) & ~inside
        # Most cells around a patch of a third face of a corner are inside walls and unknown.
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
    """Return per plane the cells where most views' normals fit it better than its grounds; all without grounds."""
    # The normals of a view take more memory than all its other data, so only those of one view exist at a time.
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
    """Return [H, W, 3], unit normals of the surface that a view shows, blurred because the ground may be rough."""
    sigma = NORMAL_SMOOTHING * view.depth.shape[1]
    known = (view.depth > 0) & ~view.masked
    weight = ndimage.gaussian_filter(known.astype(np.float64), sigma)
    disparity = np.where(known, geometry.reciprocal(view.depth.astype(np.float64)), 0)
    smooth = ndimage.gaussian_filter(disparity, sigma)
    return surface_normals(geometry.reciprocal(smooth / np.maximum(weight, 1e-9)), view.camera)
