"""Planes that stand around a hole, and where each goes on into space that no photograph shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from scipy import ndimage

from reffusion import geometry, seeding
from reffusion.background.borders import RIM, between
from reffusion.background.corners import reached, third_faces
from reffusion.background.plane import CELLS, Plane
from reffusion.background.plane_fit import TURNED, best_plane, surface_samples, told
from reffusion.background.visibility import SURFACE, Witness, seen_by, votes
from reffusion.gaussians.surfels import surface_normals
from reffusion.morphology import hull
from reffusion.types import Camera

REACH = 2.5  # radii of the object around its middle within which surfaces are looked for
TOLERANCE = 0.08  # of the object's radius: distance within which a sample belongs to a plane
SPREAD = 0.25  # of the object's radius: how far from their middle points must lie to all sides to tell where a plane is
LEAST_SHARE = 0.1  # of the samples that a plane must explain
MOST = 5  # planes
LARGE = 0.05  # of the largest patch of seen cells: smaller ones are no part of the plane
WITHIN = (0.05, 0.03, 0.015, 0.015)  # relative depth within which a view's pixels belong to a plane, step by step
ENOUGH = 200  # pixels that must
FAR = 0.08  # relative depth: a plane that would move farther anywhere in the hole stays where it is
STAYS = 0.05  # weight of the plane as it was, within the hole, against what is around
ACROSS = 0.9  # cosine of the angle between two planes under which they cross
RATHER = 1.0  # cosine to a plane over that to another, from which a surface faces rather as the one does
EVENED = 0.01  # of the image's width: the scale on which a surface's direction is taken
WIDER = 2.0  # times as wide a map on which what the plane surrounds is told
POLISHED = 0.03  # of the cells seen of a plane: smaller ones that it surrounds are unevenness
SPECK = 0.01  # of the cells seen of a plane: smaller patches that views look through are none
SURROUNDS = (
    0.8  # share of the border of what views look through that must be seen to be of the plane: a recess has less
)
TOUCHING = 0.25  # share of an unknown patch's border that must be seen for the plane to go on into it


def planes_around(
    centre: np.ndarray, radius: float, views: Sequence[Witness], points: np.ndarray, seed: int = 0
) -> list[Plane]:
    """The planes around what is removed, those with the most samples first.

    Found in the world, from the surfaces that several views show around their masks: one view's depth alone is rough,
    and a plane seen at a slant by one is seen well by another. Where a plane lies sparse points tell, if enough lie
    sharply on it (`sampled.told`).

    Args:
        centre: [3], the middle of what is removed. radius: of most of it.
        points: [P, 3], the scene's sparse points; P = 0 allowed.
    """
    samples = surface_samples(centre, REACH * radius, views, seed)
    points = points[np.linalg.norm(points - centre, axis=1) < REACH * radius]
    near, free = TOLERANCE * radius, np.ones(len(samples), bool)
    away = float(np.median([np.linalg.norm(view.camera.center - centre) for view in views])) if views else 0.0
    found: list[tuple[np.ndarray, float]] = []
    draws = np.random.default_rng(seeding.seed_for(seed, "planes around"))
    while free.sum() >= max(50, LEAST_SHARE * len(samples)) and len(found) < MOST:
        normal, height, support = best_plane(samples[free], near, draws)
        if support < LEAST_SHARE * len(samples):
            break
        by_points = told(normal, height, points, near, SPREAD * radius)
        turned, moved = by_points or (normal, height)
        if by_points or not _drawn_again(normal, height, found, centre, SURFACE * away):
            found.append((turned, moved))
        # Each has its own points, and its own samples, which lie about the plane as it is drawn.
        points = points[np.abs(points @ turned - moved) >= 1.5 * near]
        free &= np.abs(samples @ normal - height) >= 1.5 * near
    thirds = third_faces(samples, free, found, centre, radius, near)
    third = [False] * len(found) + [True] * len(thirds)
    found += thirds
    band = max(1.5 * near, SURFACE * away)
    mapped = [_mapped(*plane, centre, REACH * radius, views, so) for plane, so in zip(found, third, strict=True)]
    planes = [plane for plane, _ in mapped]
    grounds = [_crossing(plane, planes[:k]) for k, plane in enumerate(planes)]
    # What may be the one or the other is the better supported one's, unless it faces as this one does.
    faced = _faced(planes, grounds, views)
    whole: list[Plane] = []
    for (plane, hidden), below, so, narrow in zip(mapped, grounds, faced, third, strict=True):
        own = replace(plane, seen=plane.seen & so)
        if narrow:
            hidden &= reached(own, whole, views)
        whole.append(_continued(own, hidden, below, _crossing(own, planes), band, narrow))
    return whole


def _drawn_again(
    normal: np.ndarray, height: float, found: Sequence[tuple[np.ndarray, float]], centre: np.ndarray, within: float
) -> bool:
    """Whether a plane that no sparse points tell is a found one, drawn a little before or behind it: `within` the
    distance that views tell apart."""
    for other, there in found:
        beneath = centre - (centre @ other - there) * other
        if abs(normal @ other) > TURNED and abs(normal @ beneath - height) < within:
            return True
    return False


def _crossing(plane: Plane, others: Sequence[Plane]) -> list[Plane]:
    return [other for other in others if abs(other.normal @ plane.normal) < ACROSS]


def aligned(plane: Plane, depth: np.ndarray, camera: Camera, hole: np.ndarray) -> Plane:
    """The plane moved onto what one view knows of it around a hole; as it is where that is little.

    Args:
        depth: [H, W], known well where above 0. hole: bool [H, W], where the plane may have to go on: there it stays
            where it is as far as what is around does not say more.
    """
    at = plane.depth(camera)
    known = (depth > 0) & np.isfinite(at)
    rows, columns = np.nonzero(known | (hole & np.isfinite(at)))
    x, y = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
    design, prior = np.stack([x, y, np.ones_like(x)], 1), 1 / at[rows, columns]
    told, values = known[rows, columns], np.where(known, 1 / np.maximum(depth, 1e-12), 0)[rows, columns]
    found = np.linalg.lstsq(design, prior, rcond=None)[0] if len(rows) >= 3 else np.zeros(3)
    for within in WITHIN:
        off = np.abs(values / np.maximum(design @ found, 1e-12) - 1)
        mine = told & (off < within)
        if mine.sum() < ENOUGH:
            return plane
        weight = np.where(mine, 1 / mine.sum(), np.where(told, 0.0, STAYS / max((~told).sum(), 1))) / prior**2
        scaled = design * np.sqrt(weight)[:, None]
        found = np.linalg.lstsq(scaled, np.where(mine, values, prior) * np.sqrt(weight), rcond=None)[0]
    normal = found @ camera.world_to_camera[:3, :3]
    length = np.linalg.norm(normal)
    normal, height = normal / length, (1 + normal @ camera.center) / length
    moved = replace(plane, normal=normal, height=float(height))
    there = hole & np.isfinite(at)
    far = np.abs(moved.depth(camera)[there] / at[there] - 1).max() if there.any() else 0.0
    return moved if far < FAR else plane


def _hull(plane: Plane, seen: np.ndarray, grounds: Sequence[Plane]) -> np.ndarray:
    """bool [CELLS, CELLS], the convex hull of the large patches of seen cells: a surface ends where the prolongations
    of its visible borders do. What stands on one of the grounds, planes that it crosses, goes on down to it."""
    patches, count = ndimage.label(_solid(seen))
    areas = np.bincount(patches.ravel(), minlength=count + 1)
    areas[0] = 0
    large = (areas >= LARGE * max(areas.max(), 1))[patches]
    standing = plane.cells[large]
    for other in grounds:
        down = other.normal - (other.normal @ plane.normal) * plane.normal
        feet = standing + ((other.height - standing @ other.normal) / (down @ down))[:, None] * down
        large[tuple(plane.cell_of(feet).clip(0, CELLS - 1).T)] = True
    return hull(large)


def _solid(seen: np.ndarray) -> np.ndarray:
    """bool [CELLS, CELLS]: seen cells without thin rims."""
    return cv2.morphologyEx(seen.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2 * RIM + 1,) * 2, np.uint8)) > 0


def _mapped(
    normal: np.ndarray, height: float, centre: np.ndarray, reach: float, views: Sequence[Witness], third: bool
) -> tuple[Plane, np.ndarray]:
    """The plane with a map of where views show it and where they look through it; and bool [CELLS, CELLS], where
    the object hides it from some."""
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    along = np.stack([first / np.linalg.norm(first), np.cross(normal, first / np.linalg.norm(first))])
    origin, pitch = centre - (centre @ normal - height) * normal, 2 * reach / CELLS
    nowhere = np.zeros((CELLS, CELLS), bool)
    plane = Plane(normal, height, origin, along, pitch, nowhere, nowhere, nowhere, nowhere, nowhere)
    # On the object's side: a table's underside, seen from below, is not the top under the object. An object before a
    # wall's edge stands to both sides of the third face: on that from where more of it is seen.
    facing = normal if centre @ normal > height else -normal
    if not any(view.camera.center @ facing > plane.origin @ facing for view in views):
        facing = -facing  # a table's top is seen from above only, also where what stands before it is lower
    seen, free, hidden = _looked_at(plane, facing, views)
    if third and (other := _looked_at(plane, -facing, views))[0].sum() > seen.sum():
        facing, (seen, free, hidden) = -facing, other
    wider = replace(plane, pitch=WIDER * pitch)
    pit = wider.in_cells(_surrounded(*_looked_at(wider, facing, views)[:2]), plane.cells.reshape(-1, 3))
    pit = free & ndimage.binary_dilation(pit.reshape(free.shape), iterations=2)
    return replace(plane, seen=seen, free=free & ~_specks(free, SPECK * seen.sum()), pit=pit), hidden


def _specks(free: np.ndarray, small: float) -> np.ndarray:
    """bool [CELLS, CELLS]: patches of fewer than `small` free cells. Beside the object's edge a view's depth errs."""
    patches, count = ndimage.label(np.pad(free, 1, constant_values=True))  # beyond the map a patch may go on
    areas = np.bincount(patches.ravel(), minlength=count + 1)
    return free & (areas < small)[patches][1:-1, 1:-1]


def _looked_at(plane: Plane, facing: np.ndarray, views: Sequence[Witness]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """bool [CELLS, CELLS] each: where views show the plane, from the side that `facing` [3] points to, where they look
    through it, and where the object hides it from some."""
    said = votes(plane.cells.reshape(-1, 3), views, np.broadcast_to(facing, (CELLS * CELLS, 3)))
    seen, free = (said.seen >= 1) & (said.seen >= said.free), said.empty
    return tuple(each.reshape(CELLS, CELLS) for each in (seen, free, said.hidden > 0))


def _surrounded(seen: np.ndarray, free: np.ndarray) -> np.ndarray:
    """bool [CELLS, CELLS]: the large patches of free cells that seen ones surround."""
    patches, count = ndimage.label(np.pad(free, 1, constant_values=True))
    found = np.zeros(patches.shape, bool)
    around = np.pad(seen, 1)
    for patch in set(range(1, count + 1)) - {patches[0, 0]}:
        inside = patches == patch
        border = ndimage.binary_dilation(inside) & ~inside
        large = inside.sum() > POLISHED * seen.sum()
        found |= inside & (large and around[border].mean() > SURROUNDS)
    return found[1:-1, 1:-1]


def _continued(
    plane: Plane, hidden: np.ndarray, grounds: Sequence[Plane], others: Sequence[Plane], band: float, narrow: bool
) -> Plane:
    """The plane with where it goes on: a patch of it that nobody saw, because the object was in the way, and that
    touches what was seen of it, belongs to it up to its border; where views look through it, it is not.

    Args:
        hidden: bool [CELLS, CELLS], where the object hides it.
        others: planes that cross it. grounds: those of them with more samples.
        band: distance from these up to which a view that seems to show the one may show the other.
        narrow: of a patch's border only what is known of tells whether it touches what was seen: most of the rest is
            within walls.
    """
    # Neither a thin rim nor a crossing tells where the plane goes on to.
    seen, free = plane.seen | plane.pit, plane.free & ~plane.pit
    own = seen.copy()
    for other in others if not narrow else ():
        own &= np.abs(plane.cells @ other.normal - other.height) >= band
    unknown = ~seen & ~free & hidden
    patches, count = ndimage.label(unknown)
    goes_on, ends = np.zeros((2, *hidden.shape), bool)
    for patch in range(1, count + 1):
        inside = patches == patch
        border = ndimage.binary_dilation(inside, iterations=2) & ~inside
        told = border & (seen | free) if narrow else border
        if inside.sum() >= 4 and seen[told].sum() > TOUCHING * told.sum():
            beyond = between(inside, _solid(own), free) < 0.5
            goes_on |= inside & ~beyond
            ends |= inside & beyond
    goes_on &= _hull(plane, own if grounds else seen, grounds)
    within = goes_on | (ndimage.binary_fill_holes(seen | goes_on) & ~seen & ~ends & hidden)
    return replace(plane, goes_on=goes_on, within=within)


def _faced(planes: Sequence[Plane], grounds: Sequence[Sequence[Plane]], views: Sequence[Witness]) -> list[np.ndarray]:
    """For each plane bool [CELLS, CELLS]: of the views that show a surface at a cell, most show one that faces rather
    as the plane does than as one of its grounds, which cross it; everywhere where it has none.

    A view's normals take more room than all else that is known of it, so they are there for one at a time.
    """
    cells = [plane.cells.reshape(-1, 3) for plane in planes]
    likewise, shown = ([np.zeros(len(points), np.int64) for points in cells] for _ in range(2))
    for view in views if any(grounds) else ():
        facing = _facing(view)
        for k, (plane, below) in enumerate(zip(planes, grounds, strict=True)):
            if not below:
                continue
            on = seen_by(view, cells[k])
            there, _ = geometry.sample_nearest(facing, geometry.project(cells[k], view.camera)[0])
            other = np.max([np.abs(there @ each.normal) for each in below], 0)
            shown[k] += on
            likewise[k] += on & (np.abs(there @ plane.normal) > RATHER * other)
    return [
        (2 * likewise[k] > shown[k]).reshape(plane.seen.shape) if grounds[k] else np.ones_like(plane.seen)
        for k, plane in enumerate(planes)
    ]


def _facing(view: Witness) -> np.ndarray:
    """[H, W, 3] unit normals of what a view shows, evened out over rough ground."""
    sigma = EVENED * view.depth.shape[1]
    told = (view.depth > 0) & ~view.hidden
    known = ndimage.gaussian_filter(told.astype(np.float64), sigma)
    even = ndimage.gaussian_filter(np.where(told, geometry.reciprocal(view.depth.astype(np.float64)), 0), sigma)
    return surface_normals(geometry.reciprocal(even / np.maximum(known, 1e-9)), view.camera)
