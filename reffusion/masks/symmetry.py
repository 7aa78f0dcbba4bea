"""Things that stand beside the object and are their own mirror images: what nobody saw of them is like what is seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from scipy import ndimage
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from reffusion import geometry
from reffusion.masks.plane import Plane, without_pits
from reffusion.masks.witness import Votes, Witness, pixels, seen_by, smoothed_surface, votes
from reffusion.paint.painting import drawn_across
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians

REACH = 3.0  # radii of the object around its middle within which a thing must end
TOP = 1.25  # radii of it above its middle up to which things are looked at: what stands in a vase is none of it
CELL = 0.05  # of the object's radius: side of the cells that a thing is made of
ABOVE = 2.5  # cells above the ground, and off planes along it, from which something stands there
VIEWS = 12  # views that things are looked for in, every second of their rows and columns
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
HALF = 0.5  # alpha from which a thing's image is there
GAP = 0.01  # of the image's width: the radius of gaps in what is seen of a thing that are of no account
WINDOW = 0.025  # the same, of those that its image does not have, but for their texture
DEEPER = 1.02  # of the depth around, from which a place is such a window
TRUSTED = 0.25  # share of the views that look its way in which a surface must be seen, not stand behind another


@dataclass(frozen=True)
class Drawn:
    """What a view shows of a thing's mirror image.

    Attributes:
        depth: [H, W] float64 of the whole image, inf where there is none.
        supposed: the same, where the thing itself is seen, and no view looks past its image; inf elsewhere.
        told: bool [H, W], where its picture is that of what is seen; where it is not, in gaps, it is another one.
        picture: [H, W, 3] uint8.
    """

    depth: np.ndarray
    supposed: np.ndarray
    told: np.ndarray
    picture: np.ndarray


@dataclass(frozen=True)
class Mirror:
    """A thing, and a mirror that shows it as it is, so far as photographs tell.

    Attributes:
        thing: its Gaussians.
        normal: [3] of unit length, height: the mirror is at normal . x = height.
    """

    thing: Gaussians
    normal: np.ndarray
    height: float

    def image_of(self, points: np.ndarray) -> np.ndarray:
        """The mirror images of points [..., 3]."""
        return points - 2 * ((points @ self.normal) - self.height)[..., None] * self.normal

    def behind(self, camera: Camera) -> Camera:
        """The camera's mirror image. It sees the thing as the camera sees the thing's image, left and right swapped."""
        swap, turn = np.diag([-1.0, 1.0, 1.0, 1.0]), np.eye(4)
        turn[:3, :3] -= 2 * np.outer(self.normal, self.normal)
        turn[:3, 3] = 2 * self.height * self.normal
        return replace(camera, cx=camera.width - camera.cx, world_to_camera=swap @ camera.world_to_camera @ turn)

    @torch.no_grad()
    def drawn(self, camera: Camera, asked: np.ndarray, views: Sequence[Witness]) -> Drawn:
        """What a view shows of the thing's image.

        Args:
            asked: bool [H, W], pixels of which it is asked whether photographs speak for the image.
        """
        across = self.behind(camera)
        shown = rasterizer.render(self.thing, across)
        depth = torch.where(shown.alpha > HALF, shown.depth, 0).double().cpu().numpy()
        picture = (shown.color / shown.alpha.clamp_min(HALF)[..., None]).clamp(0, 1).cpu().numpy()
        rows, columns = np.nonzero(asked[:, ::-1] & (depth > 0))
        points, normals = (each[rows, columns] for each in smoothed_surface(depth, across))
        facing = normals - 2 * (normals @ self.normal)[:, None] * self.normal
        possible, told = np.zeros((2, *depth.shape), bool)
        possible[rows, columns] = ~_empty(votes(self.image_of(points), views, facing))
        told[rows, columns] = _shown(votes(points, views, normals))
        told &= depth < DEEPER * _opened(depth, WINDOW)
        whole = _closed(told, WINDOW)
        depth = np.where(whole & ~told, drawn_across(depth, told), depth) if told.any() else depth
        flipped = lambda values: np.ascontiguousarray(values[:, ::-1])
        everywhere = flipped(np.where(depth > 0, depth, np.inf))
        supposed = np.where(flipped(whole & possible), everywhere, np.inf)
        return Drawn(everywhere, supposed, flipped(_closed(told, GAP)), flipped((picture * 255 + 0.5).astype(np.uint8)))


def imaged(mirrors: Sequence[Mirror], camera: Camera, asked: np.ndarray, views: Sequence[Witness]) -> Drawn:
    """What a view shows of all the images, the nearest of those supposed at each pixel; see `Mirror.drawn`."""
    nowhere = np.full(asked.shape, np.inf)
    found = Drawn(nowhere, nowhere, np.zeros_like(asked), np.zeros((*asked.shape, 3), np.uint8))
    for mirror in mirrors:
        each = mirror.drawn(camera, asked, views)
        first = (each.supposed < found.supposed) | (np.isinf(found.supposed) & (each.depth < found.depth))
        found = Drawn(
            np.where(first, each.depth, found.depth),
            np.where(first, each.supposed, found.supposed),
            np.where(first, each.told, found.told),
            np.where(first[..., None], each.picture, found.picture),
        )
    return found


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
    ground, cell = max(planes, key=lambda plane: int(plane.seen.sum())), CELL * radius
    up = ground.normal if centre @ ground.normal > ground.height else -ground.normal
    found: list[Mirror] = []
    for points in _things(centre, radius, up, views, planes):
        near = cKDTree(points).query(gaussians.means.double().cpu().numpy(), distance_upper_bound=ABOVE * cell)[0]
        own = torch.from_numpy(np.isfinite(near)).to(gaussians.means.device)
        chosen = _chosen(points, up, cell, views, photos)
        found += [Mirror(gaussians.map(lambda p, own=own: p[own]), *mirror) for mirror in chosen]
    return found


def _things(
    centre: np.ndarray, radius: float, up: np.ndarray, views: Sequence[Witness], planes: Sequence[Plane]
) -> list[np.ndarray]:
    """The middles [P, 3] of the cells of each thing: what views show above the ground, connected, within reach."""
    cell = CELL * radius
    seen = [np.zeros((0, 3))]
    for view in views[:: max(1, len(views) // VIEWS)]:
        depth = without_pits(view.depth, view.camera, planes)
        points = geometry.unproject(depth, view.camera)[::2, ::2][(~view.hidden & (depth > 0))[::2, ::2]]
        seen.append(points[_away(points, centre, up) < REACH * radius])
    points = np.concatenate(seen)
    for plane in planes:
        if abs(plane.normal @ up) > AGREES:
            points = points[np.abs(points @ plane.normal - plane.height) > ABOVE * cell]
    ground = max(planes, key=lambda plane: int(plane.seen.sum()))
    height = points @ up
    points = points[
        (height > ground.height * (ground.normal @ up) + ABOVE * cell) & (height < centre @ up + TOP * radius)
    ]
    if not len(points):
        return []
    at = np.floor(points / cell).astype(np.int64)
    at -= at.min(0)
    number, of, count = np.unique(np.ravel_multi_index(at.T, at.max(0) + 1), return_inverse=True, return_counts=True)
    middles = np.stack([np.bincount(of, points[:, k]) / count for k in range(3)], 1)
    said = votes(middles, views)
    there = _shown(said) & (count >= 3) & (said.seen >= 2) & (said.seen > said.free)
    filled = np.zeros(at.max(0) + 1, bool)
    filled.ravel()[number[there]] = True
    thing = ndimage.label(filled, np.ones((3, 3, 3)))[0].ravel()[number[there]]
    middles = middles[there]
    parts = [middles[thing == k] for k in np.flatnonzero(np.bincount(thing, minlength=1) >= FEWEST) if k]
    ends = lambda part: (_away(part, centre, up) > REACH * radius - 2 * cell).mean() < OVER
    return [part for part in parts if ends(part)]


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
            images = points - 2 * (points @ normal - height)[:, None] * normal
            said = votes(images, views)
            far = cKDTree(known).query(images, distance_upper_bound=NEAR * cell)[0] > NEAR * cell
            gains.append(images[far & ~_shown(said) & ~_empty(said) & (said.hidden > 0)])
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
        images = asked - 2 * (asked @ normal - height)[:, None] * normal
        on = tree.query(images, distance_upper_bound=NEAR * cell)[0] < NEAR * cell
        return float((on & moved).mean()), float((_empty(votes(images, some)) & ~on & moved).mean())

    def cost(mirror: Sequence[float]) -> float:
        on, empty = told(*mirror)
        return COSTS * empty - on

    tried = []
    for angle in np.linspace(0, np.pi, ANGLES, endpoint=False):
        low, high = np.percentile(points @ normal_at(angle), [10, 90])
        tried += [(angle, height) for height in np.linspace(low, high, PLACES)]
    found = []
    for angle, height in sorted(tried, key=cost)[:FIRST]:
        start = [[angle, height], [angle + 0.06, height], [angle, height + 2 * cell]]
        best = minimize(cost, start[0], method="Nelder-Mead", options={"initial_simplex": start, "maxfev": 40}).x
        on, empty = told(*best)
        if on > COVERS and on > AGREES * (on + empty):
            found.append((normal_at(best[0]), float(best[1])))
    return found


def _closed(mask: np.ndarray, fraction: float) -> np.ndarray:
    """bool [H, W], with gaps closed up to a radius, / image width."""
    disk, reach = _disk(fraction, mask.shape[1])
    padded = np.pad(mask.astype(np.uint8), reach)
    return cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disk)[reach:-reach, reach:-reach] > 0


def _opened(depth: np.ndarray, fraction: float) -> np.ndarray:
    """[H, W] of a depth map, 0 where nothing is shown, that of what is around where it is deeper in a small place."""
    disk, _ = _disk(fraction, depth.shape[1])
    return cv2.morphologyEx(np.where(depth > 0, depth, depth.max()), cv2.MORPH_OPEN, disk)


def _disk(fraction: float, width: int) -> tuple[np.ndarray, int]:
    reach = pixels(fraction, width)
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1)), reach


def _alike(
    points: np.ndarray, mirrors: Sequence[tuple[np.ndarray, float]], cell: float, colors: np.ndarray
) -> list[tuple[np.ndarray, float]]:
    """Those of the mirrors whose images have rather the colours [P, 3] of where they lie than of anywhere."""
    tree, anywhere, found = cKDTree(points), np.random.default_rng(0).permutation(len(points)), []
    for normal, height in mirrors:
        moved = np.abs(points @ normal - height) > NEAR * cell
        images = points - 2 * (points @ normal - height)[:, None] * normal
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


def _shown(said: Votes) -> np.ndarray:
    """bool [P]: enough views show a surface there."""
    return said.seen >= np.maximum(1, TRUSTED * (said.seen + said.behind))


def _empty(said: Votes) -> np.ndarray:
    """bool [P]: views look past it."""
    return (said.free >= 2) & (said.free > said.seen)
