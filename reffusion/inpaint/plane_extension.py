"""Continuation of the scene's large planes, such as floors and walls, beyond what the training views show.

New views may look past the border of the capture. There, each plane that reaches the border goes on for a share of a
picture's width, with texture that patches of its visible part make. Cells in the frame of a training view stay as they
are, so the training views do not change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import NamedTuple

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial.transform import Rotation

from reffusion import geometry, seeding
from reffusion.background.plane_fit import search_planes
from reffusion.background.visibility import OPAQUE, smooth_surface
from reffusion.inpaint.patchmatch.completion import complete
from reffusion.inpaint.source_image import flat_source
from reffusion.kernels.compiled import map_in_threads
from reffusion.morphology import label_sizes, nearest_known
from reffusion.splat import rasterizer
from reffusion.splat.conventions import SH0
from reffusion.types import Camera, Gaussians

LONGEST, MAX_VIEWS = 320, 60  # px, larger side of the rendered training views; number of them at most
SAMPLES = 800  # points of each view to which planes are fitted
MAX_PLANES, MIN_SHARE = 8, 0.025  # number of planes at most; least share of all samples that lie on a plane
INLIER = 2.5  # px of a rendered view at the median distance: distance within which a sample lies on a plane
CROSSING = 6.0  # in inlier distances: cells so close to an earlier plane belong to that plane
MIN_COSINE = 0.8  # between the normals of a plane and of the surface that a view shows on it
REACH = 0.3  # of a picture's larger side at the median distance: how far from its seen part a plane goes on
FRAME_MARGIN = 0.2  # of a picture's width and height: how far beyond the frame of a view a plane goes on
SIDE = 320  # cells, larger side of a plane's map at most
MAIN = 0.4  # of the area of the largest patch of seen cells: smaller patches do not go on
CONTACT = 3  # cells between a seen cell and the first cell outside all frames
MIN_CONTACT = 0.3  # number of cells along the border, relative to the square root of the number of seen cells
MIN_CELLS = 20  # a plane with fewer cells to paint does not go on
DISK, THICKNESS, OPACITY = 0.45, 0.02, 0.98  # standard deviations of the disks in cells; their opacity


class _View(NamedTuple):
    """A rendered training view: camera, depth [H, W] (0 where unknown), unit normals and colors [H, W, 3]."""

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
        in_frame: bool [h, w], True for cells that lie in the frame of a training view, even if something hides them.
        near_frame: bool [h, w], the same for frames that are `FRAME_MARGIN` wider on each side.
        seen: bool [h, w], True where views show the plane.
        color: [h, w, 3] in [0, 1], what the view that sees a cell best shows there; 0 where not seen.
        target: bool [h, w], True for cells into which the plane may go on.
    """

    normal: np.ndarray
    offset: float
    corner: np.ndarray
    axes: np.ndarray
    cell_size: float
    in_frame: np.ndarray
    near_frame: np.ndarray
    seen: np.ndarray
    color: np.ndarray
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
def extend_planes(gaussians: Gaussians, cameras: Sequence[Camera]) -> Gaussians:
    """Return new Gaussians, float32 on the CPU, that continue the scene's planes beyond the training views.

    Args:
        gaussians: the scene.
        cameras: the training views, at least one.

    Returns:
        Thin disks of one color each, without the scene's Gaussians; none if no plane reaches the border of the capture.
    """
    extension = gaussians.map(lambda p: p[:0].float().cpu())
    views = [_render(gaussians, camera) for camera in cameras[:: max(1, -(-len(cameras) // MAX_VIEWS))]]
    samples, pixel_size = _sample(views)
    if not len(samples):
        return extension
    reach = REACH * max(views[0].camera.width, views[0].camera.height) * pixel_size
    maps = _map_planes(_find_planes(samples, INLIER * pixel_size), samples, pixel_size, reach, views, cameras)
    maps = [_mark_targets(each, reach) for each in maps]
    viewpoint = np.mean([camera.center for camera in cameras], axis=0)
    targets = [_visible_target(each, [other for other in maps if other is not each], viewpoint) for each in maps]
    continued = [(each, target) for each, target in zip(maps, targets, strict=True) if target.sum() >= MIN_CELLS]
    painted = map_in_threads(lambda pair: _paint(*pair), continued)
    for (each, target), colors in zip(continued, painted, strict=True):
        disks = _make_disks(each, target, colors, gaussians)
        extension = extension.zip_map(disks, lambda a, b: torch.cat([a, b]))
    return extension


def _render(gaussians: Gaussians, camera: Camera) -> _View:
    """Render a training view at reduced resolution."""
    small = camera.shrunk(LONGEST)
    rendering = rasterizer.render(gaussians, small)
    alpha = rendering.alpha.double().cpu().numpy()
    depth = np.where(alpha > OPAQUE, rendering.depth.double().cpu().numpy(), 0.0)
    color = rendering.color.double().cpu().numpy() / np.maximum(alpha, OPAQUE)[..., None]
    return _View(small, depth, smooth_surface(depth, small)[1], color.clip(0, 1))


def _sample(views: Sequence[_View]) -> tuple[np.ndarray, float]:
    """Return random visible points [S, 3], S may be 0, and the median size of a pixel there, in world units."""
    generator = np.random.default_rng(seeding.seed_for(0, "surfaces of the scene"))
    points, sizes = [np.zeros((0, 3))], [np.zeros(0)]
    for view in views:
        rows, columns = np.nonzero(view.depth > 0)
        chosen = generator.choice(len(rows), min(SAMPLES, len(rows)), replace=False) if len(rows) else []
        at = rows[chosen], columns[chosen]
        points.append(geometry.unproject(np.where(view.depth > 0, view.depth, 1.0), view.camera)[at])
        sizes.append(view.depth[at] / view.camera.fx)
    found = np.concatenate(sizes)
    return np.concatenate(points), float(np.median(found)) if len(found) else 0.0


def _find_planes(samples: np.ndarray, inlier: float) -> list[tuple[np.ndarray, float]]:
    """Find planes by RANSAC, and return the normal [3] and offset of each, about by decreasing number of samples."""
    generator = np.random.default_rng(seeding.seed_for(0, "planes of the scene"))
    return list(islice(search_planes(samples, inlier, generator, MIN_SHARE * len(samples), claimed=2), MAX_PLANES))


def _map_planes(
    planes: Sequence[tuple[np.ndarray, float]],
    samples: np.ndarray,
    pixel_size: float,
    reach: float,
    views: Sequence[_View],
    cameras: Sequence[Camera],
) -> list[_PlaneMap]:
    """Map all planes, without targets; a map extends by `reach` beyond the samples [S, 3] on its plane."""

    def observe(plane: tuple[np.ndarray, float]) -> _PlaneMap:
        near = samples[np.abs(samples @ plane[0] - plane[1]) < INLIER * pixel_size]
        return _observe(_empty_map(*plane, near, pixel_size, reach), views, cameras)

    maps = []
    for index, plane_map in enumerate(map_in_threads(observe, planes)):
        # a cell near an earlier plane counts as unseen, since it belongs to that plane
        for other, distance in planes[:index]:
            apart = np.abs(plane_map.centers @ other - distance) > CROSSING * INLIER * pixel_size
            plane_map = replace(plane_map, seen=plane_map.seen & apart)
        maps.append(plane_map)
    return maps


def _empty_map(normal: np.ndarray, offset: float, points: np.ndarray, pixel_size: float, reach: float) -> _PlaneMap:
    """Return a map that covers points [P, 3] near the plane and a margin of width `reach`, with all cells unseen."""
    middle = np.median(points, 0)
    middle = middle - (middle @ normal - offset) * normal
    first = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    first = first - (first @ normal) * normal
    axes = np.stack([first, np.cross(normal, first)]) / np.linalg.norm(first)
    low, high = np.percentile((points - middle) @ axes.T, [1, 99], axis=0)
    low, high = low - reach, high + reach
    cell_size = max(pixel_size, float((high - low).max()) / SIDE)
    shape = tuple(np.ceil((high - low) / cell_size).astype(int))
    none = np.zeros(shape, bool)
    return _PlaneMap(
        normal, offset, middle + low @ axes, axes, cell_size, none, none, none, np.zeros((*shape, 3)), none
    )


def _observe(plane_map: _PlaneMap, views: Sequence[_View], cameras: Sequence[Camera]) -> _PlaneMap:
    """Return the map with its seen cells and their colors, from `views`, and its cells in the frames of `cameras`."""
    shape, normal = plane_map.seen.shape, plane_map.normal
    points = plane_map.centers.reshape(-1, 3)
    in_frame, near_frame = np.zeros((2, len(points)), bool)
    for camera in cameras:
        left = np.flatnonzero(~in_frame)
        uv, z = geometry.project(points[left], camera)
        in_frame[left] = geometry.is_in_frame(uv, z, camera)
        near_frame[left] |= geometry.is_in_frame(uv, z, camera, FRAME_MARGIN)
    seen, color = np.zeros(len(points), bool), np.zeros((len(points), 3))
    seen[in_frame], color[in_frame] = _gather_colors(points[in_frame], normal, views)
    return replace(
        plane_map,
        in_frame=in_frame.reshape(shape),
        near_frame=near_frame.reshape(shape),
        seen=seen.reshape(shape),
        color=color.reshape(*shape, 3),
    )


def _gather_colors(points: np.ndarray, normal: np.ndarray, views: Sequence[_View]) -> tuple[np.ndarray, np.ndarray]:
    """Return which points of a plane more views show than see through, and their colors in the best view."""
    seen, free = np.zeros(len(points), int), np.zeros(len(points), int)
    best, color = np.zeros(len(points)), np.zeros((len(points), 3))
    for view in views:
        uv, z = geometry.project(points, view.camera)
        depth, inside = geometry.sample_nearest(view.depth, uv)
        aligned = np.abs(geometry.sample_nearest(view.normal, uv)[0] @ normal) > MIN_COSINE
        shows = inside & (z > 0) & (depth > 0) & (np.abs(z - depth) < geometry.SAME_SURFACE * depth) & aligned
        seen += shows
        free += inside & (z > 0) & (z < (1 - geometry.OTHER_SURFACE) * depth)
        ray = points - view.camera.center
        quality = np.abs(ray @ normal) / np.linalg.norm(ray, axis=1) ** 3  # cosine over the squared distance
        # best: near, and along the normal
        better = shows & (quality > best)
        best[better] = quality[better]
        at = uv[better, ::-1].T - 0.5
        bilinear = lambda channel, at=at: ndimage.map_coordinates(channel, at, order=1, mode="nearest")
        color[better] = np.stack([bilinear(channel) for channel in np.moveaxis(view.color, -1, 0)], 1)
    return (seen > free) & (best > 0), color


def _mark_targets(plane_map: _PlaneMap, reach: float) -> _PlaneMap:
    """Return the map with the cells into which the plane may go on, up to `reach` from where the capture ends it."""
    seen, outside = plane_map.seen, ~plane_map.in_frame
    if not seen.any():
        return plane_map
    parts, sizes = label_sizes(seen)
    large = seen & (sizes >= MAIN * sizes.max())[parts]
    # the capture ends the plane where seen cells meet cells outside all frames
    border = ndimage.binary_dilation(large, iterations=CONTACT) & outside
    areas, area_count = ndimage.label(outside)
    lengths = np.bincount(areas[border], minlength=area_count + 1)
    reached = outside & np.isin(areas, np.flatnonzero(lengths > MIN_CONTACT * math.sqrt(seen.sum())))
    border &= reached
    if not border.any():
        return plane_map
    distance = ndimage.distance_transform_edt(~border) * plane_map.cell_size
    return replace(plane_map, target=reached & plane_map.near_frame & (distance < reach))


def _visible_target(plane_map: _PlaneMap, others: Sequence[_PlaneMap], viewpoint: np.ndarray) -> np.ndarray:
    """Return bool [h, w], the target cells that no other plane occludes from `viewpoint` [3], next to seen cells."""
    target = plane_map.target.copy()
    for other in others:
        target &= ~other.occludes(plane_map.centers, viewpoint)
    return target & ndimage.binary_propagation(plane_map.seen, mask=target | plane_map.seen)


def _paint(plane_map: _PlaneMap, target: np.ndarray) -> np.ndarray:
    """Return [n, 3] in [0, 1], the colors of the n target cells, made of patches of the seen cells."""
    # the cells around must not be black
    image = (255 * plane_map.color[nearest_known(plane_map.seen)]).round().astype(np.uint8)
    source = flat_source(image, ~plane_map.seen)
    return complete(source, target, [source], seed=0).image[target] / 255


def _make_disks(plane_map: _PlaneMap, target: np.ndarray, colors: np.ndarray, like: Gaussians) -> Gaussians:
    """Return one disk for each of the n target cells, with the colors [n, 3] and as many harmonics as `like` has."""
    count = len(colors)
    sh = np.zeros((count, like.sh.shape[1], 3))
    sh[:, 0] = (colors - 0.5) / SH0
    frame = np.stack([*plane_map.axes, np.cross(*plane_map.axes)], 1)
    x, y, z, w = Rotation.from_matrix(frame).as_quat()
    scales = np.log(plane_map.cell_size * np.array([DISK, DISK, THICKNESS]))
    logits = np.full(count, math.log(OPACITY / (1 - OPACITY)))
    arrays = plane_map.centers[target], np.tile([w, x, y, z], (count, 1)), np.tile(scales, (count, 1)), logits, sh
    return Gaussians(*(torch.from_numpy(array).float() for array in arrays), antialiased=like.antialiased)
