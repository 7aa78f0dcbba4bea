"""Continuation of the scene's large planes, such as floors and walls, beyond what the training views show.

New views may look past the border of the capture. There, each plane that reaches the border goes on for a share of a
picture's width, with texture that patches of its visible part make. Cells that a training view frames stay as they are,
so the training views do not change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial.transform import Rotation

from reffusion import geometry, seeding
from reffusion.background.plane_fit import ransac_plane
from reffusion.background.visibility import FREE, OPAQUE, SURFACE, smooth_surface
from reffusion.inpaint.patchmatch.completion import complete
from reffusion.inpaint.source_image import without_geometry
from reffusion.splat import rasterizer
from reffusion.splat.conventions import SH0
from reffusion.types import Camera, Gaussians

LONGEST, MAX_VIEWS = 320, 60  # px, larger side of the rendered training views; number of them at most
SAMPLES = 800  # points of each view to which planes are fitted
MAX_PLANES, MIN_SHARE = 8, 0.025  # number of planes at most; least share of all samples that lie on a plane
INLIER = 2.5  # px of a rendered view at the median distance: distance within which a sample lies on a plane
CROSSING = 6.0  # in inlier distances: cells so close to an earlier plane belong to that plane
MIN_COSINE = 0.8  # between the normals of a plane and of the surface that a view shows on it
REACH = 0.3  # of a picture's larger side at the median distance: how far a plane goes on
SIDE = 320  # cells, larger side of a plane's map at most
MAIN = 0.4  # of the area of the largest patch of seen cells: only such patches go on
CONTACT = 3  # cells between a seen cell and the first cell beyond the border
MIN_CONTACT = 0.3  # number of cells along the border, relative to the square root of the number of seen cells
MIN_CELLS = 20  # a plane with fewer cells to paint does not go on
DISK, THICKNESS, OPACITY = 0.45, 0.02, 0.98  # standard deviations of the disks in cells; their opacity


class _View(NamedTuple):
    """A rendered training view: camera, depth [H, W] (0 where unknown), unit normals and colours [H, W, 3]."""

    camera: Camera
    depth: np.ndarray
    normal: np.ndarray
    color: np.ndarray


@dataclass(frozen=True)
class _PlaneMap:
    """A plane with a map of square cells.

    Attributes:
        normal, offset: the plane is normal . x = offset.
        corner: [3], the point on the plane at the corner of cell [0, 0].
        axes: [2, 3], unit vectors of the map's rows and columns.
        cell_size: side of a cell in world units.
        color: [h, w, 3] in [0, 1], what the view that sees a cell best shows there; 0 where not seen.
        seen: bool [h, w], True where views show the plane.
        target: bool [h, w], True for cells into which the plane may go on.
    """

    normal: np.ndarray
    offset: float
    corner: np.ndarray
    axes: np.ndarray
    cell_size: float
    color: np.ndarray
    seen: np.ndarray
    target: np.ndarray

    @property
    def centers(self) -> np.ndarray:
        """[h, w, 3], the middles of the cells in world coordinates."""
        rows, columns = (self.cell_size * (np.arange(count) + 0.5) for count in self.seen.shape)
        return self.corner + rows[:, None, None] * self.axes[0] + columns[None, :, None] * self.axes[1]

    def occludes(self, points: np.ndarray, viewpoint: np.ndarray) -> np.ndarray:
        """Return bool [...], which points [..., 3] lie behind a seen or possible cell, seen from `viewpoint` [3]."""
        before, behind = viewpoint @ self.normal - self.offset, points @ self.normal - self.offset
        crosses = (before * behind < 0) & (np.abs(behind) > self.cell_size)
        share = np.where(crosses, before / np.where(crosses, before - behind, 1), 0)
        cell = (viewpoint + share[..., None] * (points - viewpoint) - self.corner) @ self.axes.T / self.cell_size
        inside = crosses & (cell >= 0).all(-1) & (cell < self.seen.shape).all(-1)
        row, column = np.moveaxis(np.where(inside[..., None], cell, 0).astype(np.int64), -1, 0)
        return inside & (self.seen | self.target)[row, column]


@torch.no_grad()
def extend_planes(gaussians: Gaussians, cameras: Sequence[Camera], seed: int = 0) -> Gaussians:
    """Return the Gaussians, float32 on the CPU, that continue the scene's planes beyond the training views.

    Args:
        gaussians: the scene.
        cameras: the training views.
        seed: seed of the search for planes and patches.

    Returns:
        Thin disks of one colour each, none if no plane reaches the border of the capture.
    """
    nothing = gaussians.map(lambda p: p[:0].float().cpu())
    views = [_render(gaussians, camera) for camera in cameras[:: max(1, -(-len(cameras) // MAX_VIEWS))]]
    samples, pixel_size = _sample(views, seed)
    if not len(samples):
        return nothing
    planes = _find_planes(samples, INLIER * pixel_size, seed)
    reach = REACH * max(views[0].camera.width, views[0].camera.height) * pixel_size
    maps = []
    for index, plane in enumerate(planes):
        plane_map, framed = _map_plane(plane, samples, pixel_size, reach, views, cameras)
        seen = plane_map.seen
        for normal, offset in planes[:index]:
            seen = seen & (np.abs(plane_map.centers @ normal - offset) > CROSSING * INLIER * pixel_size)
        maps.append(_with_targets(replace(plane_map, seen=seen), framed, reach))
    viewpoint = np.mean([camera.center for camera in cameras], axis=0)
    parts = []
    for each in maps:
        others = [other for other in maps if other is not each]
        occluded = [other.occludes(each.centers, viewpoint) for other in others]
        target = each.target & ~np.any(occluded, axis=0) if occluded else each.target
        patches, _ = ndimage.label(target | each.seen)
        target &= np.isin(patches, np.unique(patches[each.seen]))
        if target.sum() >= MIN_CELLS:
            parts.append(_disks(each, target, _paint(each, target, seed), gaussians))
    for part in parts:
        nothing = nothing.zip_map(part, lambda a, b: torch.cat([a, b]))
    return nothing


def _render(gaussians: Gaussians, camera: Camera) -> _View:
    """Render a training view at reduced resolution."""
    small = camera.shrunk(LONGEST)
    rendering = rasterizer.render(gaussians, small)
    alpha = rendering.alpha.double().cpu().numpy()
    depth = np.where(alpha > OPAQUE, rendering.depth.double().cpu().numpy(), 0.0)
    color = rendering.color.double().cpu().numpy() / np.maximum(alpha, OPAQUE)[..., None]
    return _View(small, depth, smooth_surface(depth, small)[1], color.clip(0, 1))


def _sample(views: Sequence[_View], seed: int) -> tuple[np.ndarray, float]:
    """Return random points [S, 3] of the visible surfaces, and the median size of a pixel there, in world units."""
    generator = np.random.default_rng(seeding.seed_for(seed, "surfaces of the scene"))
    points, sizes = [np.zeros((0, 3))], [np.zeros(0)]
    for view in views:
        rows, columns = np.nonzero(view.depth > 0)
        chosen = generator.choice(len(rows), min(SAMPLES, len(rows)), replace=False) if len(rows) else []
        at = rows[chosen], columns[chosen]
        points.append(geometry.unproject(np.where(view.depth > 0, view.depth, 1.0), view.camera)[at])
        sizes.append(view.depth[at] / view.camera.fx)
    found = np.concatenate(sizes)
    return np.concatenate(points), float(np.median(found)) if len(found) else 0.0


def _find_planes(samples: np.ndarray, inlier: float, seed: int) -> list[tuple[np.ndarray, float]]:
    """Find planes by RANSAC, and return the normal [3] and offset of each, about by decreasing number of samples."""
    generator = np.random.default_rng(seeding.seed_for(seed, "planes of the scene"))
    planes: list[tuple[np.ndarray, float]] = []
    unexplained = np.ones(len(samples), bool)
    while unexplained.sum() > MIN_SHARE * len(samples) and len(planes) < MAX_PLANES:
        normal, offset, support = ransac_plane(samples[unexplained], inlier, generator)
        if support < MIN_SHARE * len(samples):
            break
        planes.append((normal, offset))
        unexplained &= np.abs(samples @ normal - offset) >= 2 * inlier
    return planes


def _map_plane(
    plane: tuple[np.ndarray, float],
    samples: np.ndarray,
    pixel_size: float,
    reach: float,
    views: Sequence[_View],
    cameras: Sequence[Camera],
) -> tuple[_PlaneMap, np.ndarray]:
    """Map a plane: which cells views show, with which colours, and which cells lie in the frame of a training view.

    Args:
        plane: normal [3] and offset.
        samples: [S, 3], points of the visible surfaces.
        pixel_size: median size of a pixel of the rendered views on the surfaces.
        reach: distance by which the map extends beyond the samples on the plane.
        views: some training views, rendered.
        cameras: all training views.

    Returns:
        The map, whose targets are all False, and bool [h, w], the cells that a training view frames.
    """
    normal, offset = plane
    near = samples[np.abs(samples @ normal - offset) < INLIER * pixel_size]
    middle = np.median(near, 0)
    middle = middle - (middle @ normal - offset) * normal
    first = np.linalg.svd(near - middle, full_matrices=False)[2][0]
    first = first - (first @ normal) * normal
    axes = np.stack([first, np.cross(normal, first)]) / np.linalg.norm(first)
    low, high = np.percentile((near - middle) @ axes.T, [1, 99], axis=0)
    low, high = low - reach, high + reach
    cell_size = max(pixel_size, float((high - low).max()) / SIDE)
    height, width = np.ceil((high - low) / cell_size).astype(int)
    empty = np.zeros((height, width), bool)
    plane_map = _PlaneMap(
        normal, offset, middle + low @ axes, axes, cell_size, np.zeros((height, width, 3)), empty, empty
    )
    points = plane_map.centers.reshape(-1, 3)
    framed = np.zeros(len(points), bool)
    for camera in cameras:
        framed |= _project(points, camera)[2]
    seen, free = np.zeros(len(points), int), np.zeros(len(points), int)
    best, color = np.zeros(len(points)), np.zeros((len(points), 3))
    for view in views:
        uv, z, inside = _project(points, view.camera)
        column, row = np.where(inside[:, None], uv, 0).astype(np.int64).T
        depth = view.depth[row, column]
        aligned = np.abs(view.normal[row, column] @ normal) > MIN_COSINE
        shows = inside & (depth > 0) & (np.abs(z - depth) < SURFACE * depth) & aligned
        seen += shows
        free += inside & (z < (1 - FREE) * depth)
        ray = points - view.camera.center
        frontal = np.abs(ray @ normal) / np.linalg.norm(ray, axis=1) ** 3  # cosine over the squared distance
        better = shows & (frontal > best)
        best[better] = frontal[better]
        at = uv[better, ::-1].T - 0.5
        bilinear = lambda channel, at=at: ndimage.map_coordinates(channel, at, order=1, mode="nearest")
        color[better] = np.stack([bilinear(channel) for channel in np.moveaxis(view.color, -1, 0)], 1)
    reshape = lambda values: values.reshape(height, width, *values.shape[1:])
    return replace(plane_map, color=reshape(color), seen=reshape((seen > free) & (best > 0))), reshape(framed)


def _project(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return image points [P, 2], camera z [P], and bool [P], True where a point lies in the frame of the view."""
    uv, z = geometry.project(points, camera)
    return uv, z, (z > 0) & (uv >= 0).all(1) & (uv < (camera.width, camera.height)).all(1)


def _with_targets(plane_map: _PlaneMap, framed: np.ndarray, reach: float) -> _PlaneMap:
    """Return the map with the cells into which the plane may go on: near a border at which only the capture ends.

    Args:
        plane_map: the map.
        framed: bool [h, w], cells in the frame of a training view; they are no targets.
        reach: distance from the border up to which the plane may go on.
    """
    seen = plane_map.seen
    parts, count = ndimage.label(seen)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)[1:]
    if not count:
        return plane_map
    main = np.isin(parts, 1 + np.flatnonzero(sizes >= MAIN * sizes.max()))
    contact = ndimage.binary_dilation(main, iterations=CONTACT) & ~framed
    beyond, _ = ndimage.label(~framed)
    lengths = np.bincount(beyond[contact], minlength=beyond.max() + 1)
    reached = np.isin(beyond, np.flatnonzero(lengths > MIN_CONTACT * math.sqrt(seen.sum()))) & ~framed
    contact &= reached
    if not contact.any():
        return plane_map
    distance = ndimage.distance_transform_edt(~contact) * plane_map.cell_size
    return replace(plane_map, target=reached & (distance < reach))


def _paint(plane_map: _PlaneMap, target: np.ndarray, seed: int) -> np.ndarray:
    """Return [n, 3] in [0, 1], the colours of the n target cells, made of patches of the seen cells."""
    nearest = ndimage.distance_transform_edt(~plane_map.seen, return_distances=False, return_indices=True)
    image = (255 * plane_map.color[tuple(nearest)]).round().astype(np.uint8)  # the cells around must not be black
    source = without_geometry(image, ~plane_map.seen)
    return complete(source, target, [source], seed=seed).image[target] / 255


def _disks(plane_map: _PlaneMap, target: np.ndarray, colors: np.ndarray, like: Gaussians) -> Gaussians:
    """Return one disk for each of the n target cells, with the colours [n, 3] and as many harmonics as `like` has."""
    count = len(colors)
    sh = np.zeros((count, like.sh.shape[1], 3))
    sh[:, 0] = (colors - 0.5) / SH0
    frame = np.stack([*plane_map.axes, np.cross(*plane_map.axes)], 1)
    x, y, z, w = Rotation.from_matrix(frame).as_quat()
    scales = np.log(plane_map.cell_size * np.array([DISK, DISK, THICKNESS]))
    logits = np.full(count, math.log(OPACITY / (1 - OPACITY)))
    arrays = plane_map.centers[target], np.tile([w, x, y, z], (count, 1)), np.tile(scales, (count, 1)), logits, sh
    return Gaussians(*(torch.from_numpy(array).float() for array in arrays), antialiased=like.antialiased)
